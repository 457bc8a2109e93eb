"""A checkpoint of a session on disk: all measurements of a drive so far, without its images.

The frames that follow are measured as without an interruption. Lengths, noise, loops and graph are then computed again
for the whole drive (``docs/design/storage-and-sessions.md``).
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from slam.errors import RunError
from slam.frames import Frame, Intrinsics, RelativePose, SnippetPoses, TrackingEvent, View
from slam.frames import Sequence as FrameSequence
from slam.frontend.drive import Drive, Keyframe
from slam.frontend.failure import MeasurementFailure
from slam.frontend.image_gate import GateState
from slam.frontend.scale.road_homography import RoadStep
from slam.frontend.scale.road_plane import GroundPlane
from slam.frontend.visual.dynamic_mask import DynamicMask
from slam.frontend.visual.epipolar import UnitRelativePose
from slam.frontend.visual.motion import Motion
from slam.frontend.visual.motion_history import MotionHistory
from slam.frontend.visual.odometry import OdometryState
from slam.frontend.visual.relative_rotation import RelativeRotation
from slam.frontend.visual.tracking import Corners, TrackerState
from slam.frontend.visual.triangulated_points import TriangulatedPoints
from slam.frontend.window.local_map import LocalMap, WindowKeyframe
from slam.frontend.window.odometry import Segment, TrackedFrame, WindowState
from slam.frontend.window.relative_poses import WindowPoses
from slam.pipeline.observer import FrontEndState, RecentFrame
from slam.se3 import FloatArray
from slam.sequences.continued import Continued
from slam.storage.archive import opened_archive, read_array
from slam.storage.serialisation import Serialiser
from slam.storage.spill import SpillFile

DRIVE, KEYFRAMES = "drive.zip", "keyframes.npz"


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
        without_images = replace(state, drive=replace(state.drive, keyframes=[], examples=[]))
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
        """Write a file as in ``docs/outputs.md``."""
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
        if (folder / KEYFRAMES).exists():
            checkpoint.state.drive.keyframes.extend(read_keyframes(folder / KEYFRAMES))
        return checkpoint

    def continued(self, following: FrameSequence) -> Continued:
        """The drive extended by the frames that follow.

        Raises:
            SequenceError: another camera.
        """
        known = (self.name, self.intrinsics, self.stamps, self.camera_height_m, self.reference, self.sources)
        return Continued(*known, following)


SERIALISER = Serialiser(
    *(SessionCheckpoint, FrontEndState, Drive, GateState, OdometryState, TrackerState, MotionHistory),
    *(Corners, DynamicMask, Frame, RecentFrame, Intrinsics, Motion, UnitRelativePose, TriangulatedPoints),
    *(RelativePose, RelativeRotation, SnippetPoses, RoadStep, GroundPlane, MeasurementFailure, View),
    *(WindowPoses, WindowState, Segment, TrackedFrame, LocalMap, WindowKeyframe, TrackingEvent),
)


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
