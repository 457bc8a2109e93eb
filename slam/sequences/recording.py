"""A recording on disk as a ``Sequence``: images with calibration, stamps and ground truth.

Every kind of data set is opened by a function that returns a ``RecordedSequence``; only the source of images
(``ImageSource``) differs.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence as Items
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from erfsfm.readers.numbering import NumberedFiles
from slam import se3
from slam.errors import SequenceError, sequence_errors
from slam.frames import Frame, Image, Intrinsics
from slam.se3 import FloatArray
from slam.sequences.depth_maps import DepthMaps
from slam.sequences.images import too_long

logger = logging.getLogger(__name__)

DEFAULT_FPS = 10.0
MAX_GAP_S = 10.0


class ImageSource(Protocol):
    """Images of one size, read one at a time."""

    width: int
    height: int

    def __len__(self) -> int:
        """Number of images."""
        ...

    def read(self, index: int) -> Image:
        """One image ``(height, width, 3)`` uint8 RGB; ``SequenceError`` or ``DataError`` where it cannot be read."""
        ...


@dataclass(frozen=True)
class Source:
    """A name in the leak record and the frame of it where a sequence begins.

    ``first`` is the number that frame 0 has in the named recording (negative where the sequence begins
    earlier), or None for a source that is used as a whole, such as a simulated world. ``length`` is the
    number of frames of the named recording where known.
    """

    name: str
    first: int | None = 0
    length: int | None = None

    def shifted(self, start: int) -> Source:
        """The source of a sequence that begins ``start`` frames later."""
        return self if self.first is None else Source(self.name, self.first + start, self.length)

    def label(self, frames: int) -> str | None:
        """``name[a:b]`` for so many frames, or None where none of them is in the named recording."""
        if self.first is None:
            return self.name
        start = max(self.first, 0)
        stop = self.first + frames if self.length is None else min(self.first + frames, self.length)
        return f"{self.name}[{start}:{stop}]" if start < stop else None


def labels(sources: Items[Source], frames: int) -> tuple[str, ...]:
    """The leak record's names for so many frames of a sequence."""
    found = (source.label(frames) for source in sources)
    return tuple(label for label in found if label is not None)


@dataclass(eq=False)
class RecordedSequence:
    """Frames from an ``ImageSource``; the attributes are those of ``slam.frames.Sequence``.

    ``depth_maps`` are the true depth beside the images, where there is any.
    """

    name: str
    images: ImageSource
    intrinsics: Intrinsics
    stamps: FloatArray
    sources: tuple[Source, ...]
    reference: FloatArray | None = None
    camera_height_m: float | None = None
    T_camera_lidar: FloatArray | None = None
    scans: dict[int, Path] = field(default_factory=dict)
    depth_maps: DepthMaps | None = None

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.images)

    def frame(self, index: int) -> Frame:
        """Read one frame.

        Raises:
            MissingFrameError: if its number is missing from the files.
            SequenceError: if its image cannot be read.
        """
        require_frame(self.name, index, len(self))
        with sequence_errors():
            return Frame(index, float(self.stamps[index]), self.images.read(index))

    def scan_path(self, index: int) -> Path | None:
        """The Velodyne ``.bin`` file taken with a frame, or None."""
        return self.scans.get(index)

    def true_depth_frames(self) -> list[int]:
        """Frames with a depth map beside their image."""
        return [] if self.depth_maps is None else sorted(k for k in self.depth_maps.paths if 0 <= k < len(self))

    def true_depth(self, index: int) -> FloatArray:
        """The depth map ``(h, w)`` beside an image in metres, 0 where unknown.

        Raises:
            SequenceError: it cannot be read.
        """
        if self.depth_maps is None:
            raise SequenceError(f"{self.name} has no depth maps")
        with sequence_errors():
            return self.depth_maps.read(index)

    def provenance(self) -> tuple[str, ...]:
        """Names of the recordings, as in the leak record of a checkpoint."""
        return labels(self.sources, len(self))


def require_frame(name: str, index: int, frames: int) -> None:
    """Refuse a frame number outside a sequence.

    Raises:
        SequenceError: if ``index`` is not in [0, frames).
    """
    if not 0 <= index < frames:
        raise SequenceError(f"no frame {index} in sequence {name}: it has frames 0 to {frames - 1}")


def rebased(T_any_camera: FloatArray) -> FloatArray:
    """Poses ``T_world_camera`` ``(N, 4, 4)`` whose world is the first camera; the first is the identity."""
    T_any_first = T_any_camera[0].copy()
    T_any_first[:3, :3] = se3.nearest_rotation(T_any_first[:3, :3])
    T_world_camera: FloatArray = se3.invert(T_any_first) @ T_any_camera
    T_world_camera[0] = np.eye(4)
    return T_world_camera


def uniform_stamps(frames: int, fps: float) -> FloatArray:
    """Seconds from the first frame at a steady rate ``(frames,)``."""
    return np.arange(frames, dtype=np.float64) / fps


def fallback_stamps(path: Path, frames: int) -> FloatArray:
    """Uniform stamps in place of a missing file of stamps, with a warning."""
    logger.warning("no %s: %g frames a second are assumed", path, DEFAULT_FPS)
    return uniform_stamps(frames, DEFAULT_FPS)


def require_stamps(stamps: FloatArray, path: Path, files: NumberedFiles) -> FloatArray:
    """Stamps in seconds read from a file, one for each row of the numbered files it belongs to ``(len(files),)``.

    Args:
        stamps: one for each number from 0, one for each row, or one for each file; then those of missing files are
            interpolated.
        path: where they were read.
        files: images, or packets of a GPS/INS.

    Raises:
        SequenceError: if their number matches none of these, one is not finite, or they do not increase.
    """
    assigned = files.rows_of(len(stamps))
    if assigned is None:
        raise SequenceError(
            f"{path} has {len(stamps)} rows for {len(files.paths)} images: it needs one stamp an image; "
            f"restore the missing images or cut the file to match"
        )
    if not np.isfinite(stamps).all() or (np.diff(stamps) <= 0).any():
        row = int(np.argmin(np.r_[True, np.diff(stamps) > 0] & np.isfinite(stamps))) + 1
        raise SequenceError(f"{path} row {row}: stamps must be numbers that increase; correct the row")
    rows, skipped = assigned
    if len(rows) == len(files):
        return stamps[skipped:]
    spread: FloatArray = np.interp(np.arange(len(files)), rows, stamps)
    return spread


def require_short_gaps(files: NumberedFiles, stamps: FloatArray) -> None:
    """Warn once of missing images, and refuse gaps too long to be interpolated across.

    Raises:
        SequenceError: if a gap is longer than 10 seconds.
    """
    for first, last in files.gaps():
        if stamps[last + 1] - stamps[first - 1] > MAX_GAP_S:
            raise too_long(files, first, last)
    if files.gaps():
        logger.warning("%s: %s; the motion across gaps is interpolated", files.paths[0].parent, files.describe_gaps())


def interpolated_poses(T_any_camera: FloatArray, known: FloatArray, stamps: FloatArray) -> FloatArray:
    """Poses ``(N, 4, 4)`` at ``stamps`` ``(N,)`` from poses ``(M, 4, 4)`` at ``known`` ``(M,)``; ends are held."""
    times = np.clip(stamps, known[0], known[-1])
    R = Slerp(known, Rotation.from_matrix(T_any_camera[:, :3, :3]))(times).as_matrix()
    t = np.column_stack([np.interp(times, known, T_any_camera[:, axis, 3]) for axis in range(3)])
    return se3.make(R, t)
