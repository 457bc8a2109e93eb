"""What a run folder keeps so that the drive can go on (``run --continue``): all that was measured, and no images of it.

The frames that follow are looked at as if there had been no pause, and lengths, noise, loops and graph are then found
anew for the whole drive (``docs/design/storage-and-sessions.md``).
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from slam.errors import RunError, SlamError
from slam.frames import Frame, Intrinsics, RelativePose, SnippetPoses
from slam.frames import Sequence as FrameSequence
from slam.frontend.failure import MeasurementFailure
from slam.frontend.scale.road_homography import RoadStep
from slam.frontend.scale.road_plane import GroundPlane
from slam.frontend.visual.epipolar import TriangulatedPoints, UnitRelativePose
from slam.frontend.visual.odometry import Motion
from slam.frontend.visual.relative_rotation import RelativeRotation
from slam.frontend.visual.tracking import Corners, SeenImage
from slam.loops.descriptors import View
from slam.pipeline.observer import Keyframe, Observations, Observer
from slam.se3 import FloatArray
from slam.sequences.continued import Continued
from slam.storage.serialisation import Memento, Serialiser
from slam.storage.spill import SpillFile

DRIVE, KEYFRAMES = "drive.zip", "keyframes.npz"
_SERIALISER = Serialiser(
    *(
        Corners,
        Frame,
        UnitRelativePose,
        Intrinsics,
        Motion,
        Observations,
        MeasurementFailure,
        RelativePose,
        GroundPlane,
        RoadStep,
        SeenImage,
    ),
    *(SnippetPoses, RelativeRotation, TriangulatedPoints, View),
)


@dataclass(frozen=True)
class SessionCheckpoint:
    """A drive up to its last frame, looked at by the networks ``weights_sha256``; the rest as of a `FrameSequence`."""

    name: str
    sources: tuple[str, ...]
    weights_sha256: str
    intrinsics: Intrinsics
    camera_height_m: float | None
    stamps: FloatArray
    reference: FloatArray | None
    seen: Observations
    observer: Observer | Memento

    @classmethod
    def of(cls, sequence: FrameSequence, observer: Observer, weights_sha256: str) -> Self:
        """A drive whose last frame an observer has seen."""
        return cls(
            sequence.name,
            sequence.provenance(),
            weights_sha256,
            sequence.intrinsics,
            sequence.camera_height_m,
            sequence.stamps,
            sequence.reference,
            replace(observer.seen, keyframes=[], examples=[]),
            observer,
        )

    def write(self, path: Path) -> None:
        """Write all of it; what is in the file stands in ``docs/outputs.md``."""
        _SERIALISER.write(path, **vars(self))

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read what ``write`` wrote.

        Raises:
            RunError: missing, damaged or of another version.
        """
        content = _SERIALISER.read(path)
        try:
            return cls(**content)
        except TypeError as error:
            raise RunError(f"{path} is damaged: run the sequence again") from error

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Read what a run left in its folder, keyframes where it kept them; raises as ``read``."""
        if not (folder / DRIVE).is_file():
            raise RunError(
                f"{folder} cannot be continued: it has no {DRIVE}; give a folder that 'erfsfm-slam run' wrote and "
                "finished, and not with output.keep=nothing"
            )
        drive = cls.read(folder / DRIVE)
        if (folder / KEYFRAMES).is_file():
            drive.seen.keyframes.extend(_read_keyframes(folder / KEYFRAMES))
        return drive

    def continued(self, following: FrameSequence) -> Continued:
        """All frames of the drive with those that follow.

        Raises:
            SequenceError: another camera.
        """
        known = (self.name, self.intrinsics, self.stamps, self.camera_height_m, self.reference, self.sources)
        return Continued(*known, following)

    def resume(self, observer: Observer) -> None:
        """Let an observer go on after the last frame.

        Raises:
            RunError: what is kept does not fit this version.
        """
        if not isinstance(self.observer, Memento):
            raise SlamError(f"the drive on {self.name} is still being looked at")
        observer.seen = self.seen
        self.observer.teach(observer)


def write_keyframes(path: Path, keyframes: Sequence[Keyframe]) -> None:
    """Write thinned images ``image_N`` and unscaled depth ``depth_N``, one at a time, as compressed ``.npz``."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for keyframe in keyframes:
            for name, array in (("image", keyframe.image), ("depth", keyframe.depth_unscaled)):
                with file.open(f"{name}_{keyframe.index}.npy", "w") as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)


def _read_keyframes(path: Path) -> Iterator[Keyframe]:
    spill_file = SpillFile()
    try:
        with np.load(path, allow_pickle=False) as file:
            for index in sorted(int(name.removeprefix("image_")) for name in file.files if name.startswith("image_")):
                yield Keyframe(index, spill_file.put(file[f"image_{index}"]), spill_file.put(file[f"depth_{index}"]))
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise RunError(f"{path} is damaged ({type(error).__name__}): run the sequence again") from error
