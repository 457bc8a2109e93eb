"""A checkpoint of a session on disk: all measurements of a drive so far, without its images.

A drive that is continued, a run that was killed and a session that was saved go on from the same file. The frames that
follow are measured as without an interruption. Lengths, noise, loops and graph are then computed again for the whole
drive (``docs/design/storage-and-sessions.md``).
"""

from __future__ import annotations

import logging
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from slam.frames import Frame, Intrinsics, RelativePose, SnippetPoses, TrackingEvent, View
from slam.frames import Sequence as FrameSequence
from slam.frontend.drive import Drive, Keyframe
from slam.frontend.failure import MeasurementFailure
from slam.frontend.image_gate import GateState
from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe
from slam.frontend.keyframes.map_segment import MapSegment, TrackedFrame
from slam.frontend.keyframes.odometry import KeyframeOdometryState
from slam.frontend.keyframes.relative_poses import KeyframePoses
from slam.frontend.scale.road_homography import RoadStep
from slam.frontend.scale.road_plane import GroundPlane
from slam.frontend.visual.depth_error import DepthError
from slam.frontend.visual.dynamic_mask import DynamicMask
from slam.frontend.visual.epipolar import UnitRelativePose
from slam.frontend.visual.focal_length import FocalLength
from slam.frontend.visual.motion import Motion
from slam.frontend.visual.motion_history import MotionHistory
from slam.frontend.visual.odometry import OdometryState
from slam.frontend.visual.relative_rotation import RelativeRotation
from slam.frontend.visual.tracking import Corners, CornerTrackerState
from slam.frontend.visual.triangulated_points import TriangulatedPoints
from slam.geometry.se3 import FloatArray
from slam.pipeline.front_end_state import FrontEndState, RecentFrame
from slam.runtime.errors import RunError, SlamError
from slam.runtime.run_files import DRIVE, KEYFRAMES, KEYFRAMES_PART
from slam.runtime.storage.archive import opened_archive, read_array
from slam.runtime.storage.files import remove, write_atomically
from slam.runtime.storage.serialisation import Serialiser
from slam.runtime.storage.spill import SpillFile
from slam.sequences.continued import Continued

EVERY_FRAMES = 100
_GROWTH = 0.1  # of a drive, before its state is written again: all writes together are eleven times the last one

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SessionCheckpoint:
    """A drive up to its last frame; ``weights_sha256`` is that of the networks and the depth source.

    Other fields are as of a `Sequence`.
    """

    name: str
    sources: tuple[str, ...]
    weights_sha256: str
    intrinsics: Intrinsics
    camera_height_m: float | None
    stamps: FloatArray
    reference: FloatArray | None
    state: FrontEndState

    @classmethod
    def of(cls, sequence: FrameSequence, state: FrontEndState, weights_sha256: str) -> Self:
        """From the state of an observer after the last frame, without images."""
        without_images = replace(state, drive=replace(state.drive, keyframes=[]))
        return cls(
            sequence.name,
            sequence.provenance(),
            weights_sha256,
            sequence.intrinsics,
            sequence.camera_height_m,
            sequence.stamps,
            sequence.reference,
            without_images,
        )

    def write(self, path: Path) -> None:
        """Write a file as in ``docs/run-folder.md``."""
        SERIALISER.write(path, self)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read what ``write`` wrote.

        Raises:
            RunError: missing, damaged or of another version.
        """
        content = SERIALISER.read(path)
        if not isinstance(content, cls):
            raise RunError(f"{path} is damaged: run the sequence again")
        return content

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Read the checkpoint of a run folder, with keyframes where they were kept; raises as ``read``."""
        if not (folder / DRIVE).is_file():
            raise RunError(
                f"{folder} cannot be continued: it has no {DRIVE}; give a folder that 'erfsfm-slam run' wrote and "
                "finished, and not with output.keep=nothing"
            )
        checkpoint = cls.read(folder / DRIVE)
        drive = checkpoint.state.drive
        keyframes = {keyframe.index: keyframe for path in _keyframe_files(folder) for keyframe in read_keyframes(path)}
        drive.keyframes.extend(keyframes[index] for index in sorted(keyframes) if index < len(drive))
        return checkpoint

    @property
    def is_whole(self) -> bool:
        """Whether it has all frames of its sequence, as that of a killed run has not."""
        return len(self.state.drive) == len(self.stamps)

    def continued(self, following: FrameSequence) -> Continued:
        """The drive extended by the frames that follow.

        Raises:
            SequenceError: another camera.
        """
        known = (self.name, self.intrinsics, self.stamps, self.camera_height_m, self.reference, self.sources)
        return Continued(*known, following)


SERIALISER = Serialiser(
    *(SessionCheckpoint, FrontEndState, Drive, GateState, OdometryState, CornerTrackerState, MotionHistory),
    *(Corners, DepthError, DynamicMask, FocalLength, Frame, RecentFrame, Intrinsics, Motion, UnitRelativePose),
    *(
        TriangulatedPoints,
        RelativePose,
        RelativeRotation,
        SnippetPoses,
        RoadStep,
        GroundPlane,
        MeasurementFailure,
        View,
    ),
    *(KeyframePoses, KeyframeOdometryState, MapSegment, TrackedFrame, LocalMap, TrackedKeyframe, TrackingEvent),
)


class CheckpointWriter:
    """Keeps a drive in the folder of its run while its frames are measured, and once they are all there."""

    def __init__(
        self,
        folder: Path,
        checkpoint_of: Callable[[FrontEndState], SessionCheckpoint],
        with_keyframes: bool,
        kept: Drive | None = None,
    ) -> None:
        """Prepare for the first state.

        Args:
            folder: of the run.
            checkpoint_of: the checkpoint of a state.
            with_keyframes: also keep the frames of the map.
            kept: what a checkpoint in this folder has already.
        """
        self._folder, self._checkpoint_of, self._with_keyframes = folder, checkpoint_of, with_keyframes
        self._frames, self._keyframes = (0, 0) if kept is None else (len(kept), len(kept.keyframes))
        self._is_writable = True

    def keep(self, state: FrontEndState) -> None:
        """Write the state of a pass that goes on, at distances that grow with the drive.

        After a failure (a full disk) it warns, keeps no more, and the run goes on.
        """
        drive = state.drive
        if not self._is_writable or len(drive) - self._frames < _GROWTH * self._frames:
            return
        new = drive.keyframes[self._keyframes :]
        try:
            if self._with_keyframes and new:
                part = self._folder / f"keyframes-{len(drive):06d}.npz"
                write_atomically(part, lambda path: write_keyframes(path, new))
            write_atomically(self._folder / DRIVE, self._checkpoint_of(state).write)
        except (SlamError, OSError) as error:
            logger.warning("the state of the run is not kept any more, a killed run goes on from before: %s", error)
            self._is_writable = False
        self._frames, self._keyframes = len(drive), len(drive.keyframes)

    def finish(self, state: FrontEndState) -> None:
        """Write the state after the last frame; all keyframes are then in one file.

        Raises:
            RunError: a file cannot be written.
        """
        if self._with_keyframes:
            keyframes = state.drive.keyframes
            write_atomically(self._folder / KEYFRAMES, lambda path: write_keyframes(path, keyframes), RunError)
        write_atomically(self._folder / DRIVE, self._checkpoint_of(state).write, RunError)
        for path in _keyframe_files(self._folder):
            if path.name != KEYFRAMES:
                remove(path, RunError)


def _keyframe_files(folder: Path) -> list[Path]:
    """The files of keyframes in a folder: one, or while a pass goes on one for each time that its state was kept."""
    return sorted(path for path in folder.iterdir() if path.name == KEYFRAMES or KEYFRAMES_PART.fullmatch(path.name))


def write_keyframes(path: Path, keyframes: Sequence[Keyframe]) -> None:
    """Write thinned images ``image_N`` and unscaled depth ``depth_N``, one at a time, as compressed ``.npz``."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for keyframe in keyframes:
            for name, array in (("image", keyframe.image), ("depth", keyframe.depth_unscaled)):
                with file.open(f"{name}_{keyframe.index}.npy", "w") as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)


def read_keyframes(path: Path) -> Iterator[Keyframe]:
    """Read what `write_keyframes` wrote, into a new spill file; `RunError` where it is damaged."""
    spill_file = SpillFile()
    with opened_archive(path) as file:
        names = [name.removesuffix(".npy") for name in file.namelist()]
        for index in sorted(int(name.removeprefix("image_")) for name in names if name.startswith("image_")):
            image, depth = read_array(file, f"image_{index}"), read_array(file, f"depth_{index}")
            if image.dtype != np.uint8 or depth.dtype != np.float32 or image.shape != (*depth.shape, 3):
                raise ValueError(f"keyframe {index} is {image.dtype} {image.shape} with depth {depth.shape}")
            yield Keyframe(index, spill_file.put(image), spill_file.put(depth))
