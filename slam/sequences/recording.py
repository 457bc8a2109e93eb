"""A recording on disk as a ``Sequence``: images with calibration, stamps and ground truth.

Every kind of data set is opened by a function that returns a ``RecordedSequence``; only the source of images
(``ImageSource``) differs.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from copy import copy
from dataclasses import InitVar, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.readers.camera_file import CameraFile
from erfsfm.common.readers.numbering import NumberedFiles
from slam.formats.rows import BadRows, in_seconds, number_or_nan, rows_of
from slam.frames import Frame, Image, Intrinsics, Mask
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray, is_se3
from slam.runtime.errors import SequenceError, SlamError, sequence_errors
from slam.sequences.camera_file import Undistortion, fixed_to, require_size, undistorted
from slam.sequences.gps_track import FASTEST_M_S
from slam.sequences.images import ImageFiles, ImageSource, ReadImages, too_long
from slam.sequences.poses import known_poses, rebased

logger = logging.getLogger(__name__)

_MAX_GAP_S = 10.0
POSSIBLE_PERIODS_S = (1e-5, 1e4)  # stamps in nanoseconds or microseconds give more
_USUAL_PERIODS_S = (1e-3, 5.0)
_RIGID_TOLERANCE = 0.01
_LONG_PAUSE_S, _LONG_PAUSE_PERIODS = 30.0, 50.0
ArrayReader = Callable[[], NDArray[Any]]
ArrayReaders = dict[int, ArrayReader]  # by frame


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


@dataclass(eq=False)
class RecordedSequence:
    """Frames from an ``ImageSource``; the attributes are those of ``slam.frames.Sequence``.

    ``camera`` took the images as they are stored: where its lens is distorted they are undistorted as they are read,
    and ``depth_maps``, the true depth ``(h, w)`` in metres beside the stored images, 0 where unknown, are left out.
    ``scans`` are the points ``(P, 3)`` of the LiDAR, metres, in its frame. ``usual_height_m`` is the height of a camera
    that does not say its own. ``T_any_camera`` ``(N, 4, 4)`` are true poses in any world, NaN where unknown;
    ``reference`` follows from them where all are known. ``distance_to_surface`` gives the distance of points ``(M, 3)``
    of that world to the true surface, where the whole of it is known. Frame 0 is frame ``start`` of the ``recorded``
    ones, by which images, scans and depth maps are numbered. Depth that ``is_rendered`` takes long.
    """

    is_rendered: ClassVar[bool] = False
    name: str
    images: ImageSource
    camera: CameraFile | Intrinsics
    stamps: FloatArray
    sources: tuple[Source, ...]
    T_any_camera: FloatArray | None = None
    usual_height_m: InitVar[float | None] = None
    T_camera_lidar: FloatArray | None = None
    scans: ArrayReaders = field(default_factory=dict)
    depth_maps: ArrayReaders = field(default_factory=dict)
    distance_to_surface: Callable[[FloatArray], FloatArray] | None = None
    intrinsics: Intrinsics = field(init=False)
    undistortion: Undistortion | None = field(default=None, init=False)
    fixed: Mask | None = field(default=None, init=False)  # (H, W), by the camera's own mask
    camera_height_m: float | None = field(init=False)
    reference: FloatArray | None = field(default=None, init=False)
    start: int = field(default=0, init=False)
    recorded: int = field(init=False)

    def __post_init__(self, usual_height_m: float | None) -> None:
        """Check images, camera and stamps against each other, and rebase the poses."""
        where = self.name
        if isinstance(self.images, ImageFiles):
            _require_short_gaps(self.images.files, self.stamps)
            where = f"{self.name} in {self.images.files.paths[0].parent}"
        if isinstance(self.camera, CameraFile):
            require_size(self.images, self.camera, where)
            self.take_camera(self.camera, usual_height_m)
        else:
            self.intrinsics, self.camera_height_m = self.camera, usual_height_m
        _require_plausible_rate(self.name, self.stamps)
        if self.T_camera_lidar is not None and not is_se3(self.T_camera_lidar, _RIGID_TOLERANCE):
            raise SequenceError(
                f"{self.name}: the calibration of its LiDAR is no rotation and translation"
            )
        self.recorded = len(self.stamps)
        self.take_truth(self.T_any_camera)

    def take_camera(self, camera: CameraFile, usual_height_m: float | None) -> None:
        """Let this camera have taken the images, which are of its size."""
        self.camera, self.camera_height_m = camera, camera.height_or(usual_height_m)
        self.intrinsics, self.undistortion = undistorted(camera)
        self.fixed = fixed_to(camera, self.undistortion)
        self.depth_maps = self.depth_maps if self.undistortion is None else {}

    def cut(self, start: int, stop: int) -> Self:
        """The frames [start, stop) as a sequence of their own; stamps stay, poses begin at the identity.

        Args:
            start: the first frame of the part.
            stop: the frame after its last one.

        Raises:
            SequenceError: the sequence has no such frames.
        """
        if not 0 <= start < stop <= len(self):
            raise SequenceError(
                f"no frames {start}:{stop} in sequence {self.name}: it has {len(self)}"
            )
        part = copy(self)
        part.start, part.stamps = self.start + start, self.stamps[start:stop]
        part.sources = tuple(source.shifted(start) for source in self.sources)
        part.T_any_camera = None if self.T_any_camera is None else self.T_any_camera[start:stop]
        part.reference = _reference(part.T_any_camera)
        return part

    def take_truth(self, T_any_camera: FloatArray | None) -> None:
        """Let these be the true poses; a warning where no camera can follow them, such as millimetres, or a jump."""
        self.T_any_camera, self.reference = T_any_camera, _reference(T_any_camera)
        if self.reference is None:
            return
        speeds = np.linalg.norm(np.diff(self.reference[:, :3, 3], axis=0), axis=1) / np.diff(
            self.stamps
        )
        fast = np.flatnonzero(speeds > FASTEST_M_S)
        if fast.size:
            text = (
                "%s: its true poses move at %g m/s after frame %d: check their unit, and the stamps"
            )
            logger.warning(text, self.name, speeds[fast[0]], fast[0])

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.stamps)

    def frame(self, index: int) -> Frame:
        """Read one frame.

        Raises:
            SequenceError: there is no such frame, or its image cannot be read; `MissingFrameError`
                where its number is missing from the files.
        """
        if not 0 <= index < len(self):
            raise SequenceError(
                f"no frame {index} in sequence {self.name}: it has frames 0 to {len(self) - 1}"
            )
        with sequence_errors():
            image = self.images.read(self.start + index)
        if self.undistortion is not None:
            image = self.undistortion.apply(image)
        return Frame(index, float(self.stamps[index]), image, self.fixed)

    def has_scan(self, index: int) -> bool:
        """Whether a LiDAR scan was taken with a frame."""
        return self.start + index in self.scans

    def scan(self, index: int) -> FloatArray:
        """The points ``(P, 3)`` of a frame's scan, metres, in the LiDAR.

        Raises:
            SequenceError: the frame has no scan, or it cannot be read.
        """
        if not self.has_scan(index):
            raise SequenceError(f"frame {index} of {self.name} has no scan")
        with sequence_errors():
            return self.scans[self.start + index]()

    def true_depth_frames(self) -> list[int]:
        """Frames with a depth map beside their image."""
        return [k for k in range(len(self)) if self.start + k in self.depth_maps]

    def true_depth(self, index: int) -> FloatArray:
        """The depth map ``(h, w)`` beside an image in metres, 0 where unknown."""
        with sequence_errors():
            return np.asarray(self.depth_maps[self.start + index](), np.float64)

    def provenance(self) -> tuple[str, ...]:
        """Names of the recordings, as in the leak record of a checkpoint."""
        labels = (source.label(len(self)) for source in self.sources)
        return tuple(label for label in labels if label is not None)


class GrowingSequence(RecordedSequence):
    """A sequence that grows by a frame at a time; its images are not kept."""

    def __init__(
        self,
        camera: CameraFile | Intrinsics,
        camera_height_m: float | None = None,
        name: str = "live",
    ) -> None:
        def forgotten(index: int) -> Image:
            raise SlamError(f"frame {index} of a live drive is not kept")

        images = ReadImages(camera.width, camera.height, 0, forgotten)
        super().__init__(name, images, camera, np.zeros(0), (), usual_height_m=camera_height_m)


def _reference(T_any_camera: FloatArray | None) -> FloatArray | None:
    """The poses with the first as the world; None unless all are known."""
    if T_any_camera is None or not known_poses(T_any_camera).all():
        return None
    return rebased(T_any_camera)


def _require_plausible_rate(name: str, stamps: FloatArray) -> None:
    """Refuse stamps that cannot be seconds, such as nanoseconds, and warn of unlikely ones and of long pauses."""
    if len(stamps) < 2:
        return
    periods = np.diff(stamps)
    period, longest = median(periods), float(periods.max())
    doubt = f"{name}: its frames are {period:g} s apart: check its stamps, or fps, and their unit"
    if not POSSIBLE_PERIODS_S[0] <= period <= POSSIBLE_PERIODS_S[1]:
        raise SequenceError(doubt)
    if not _USUAL_PERIODS_S[0] <= period <= _USUAL_PERIODS_S[1]:
        logger.warning(doubt)
    if longest > max(_LONG_PAUSE_S, _LONG_PAUSE_PERIODS * period):
        logger.warning(
            "%s: its stamps pause for %g s before frame %d",
            name,
            longest,
            int(periods.argmax()) + 1,
        )


def frame_range(text: str, frames: int) -> tuple[int, int]:
    """Read ``A:B`` as Python reads a slice of so many frames: half-open, either end optional or negative.

    Unlike in Python, an end beyond the sequence is an error.

    Args:
        text: the option of the user.
        frames: their number in the sequence.

    Raises:
        SequenceError: it is no range, is empty, or reaches outside of the sequence.
    """
    try:
        begin, end = text.split(":")
        start, stop = int(begin.strip() or 0), int(end.strip() or frames)
    except ValueError:
        raise SequenceError(
            f"--frames {text!r} is not a range: write A:B, such as 0:300 or 100:"
        ) from None
    first, last = (end + frames if end < 0 else end for end in (start, stop))
    if not (0 <= first < frames and 0 <= last <= frames):
        raise SequenceError(
            f"--frames {text} reaches outside the sequence: it has {frames} frames; choose within 0:{frames}"
        )
    if first >= last:
        raise SequenceError(f"--frames {text} holds no frames: A must come before B in A:B")
    return first, last


def uniform_stamps(frames: int, fps: float) -> FloatArray:
    """Seconds from the first frame at a steady rate ``(frames,)``."""
    return np.arange(frames, dtype=np.float64) / fps


def read_stamps(path: Path, files: NumberedFiles) -> FloatArray:
    """A file with one time in seconds a row, perhaps after a number or a name, checked by `require_stamps`."""
    lines = rows_of(path, SequenceError, "one time in seconds a row")
    rows = [
        [number_or_nan(in_seconds(word)) for word in re.split(r"[,;\s]+", line)]
        for _, line in lines
    ]
    has_header = files.rows_of(len(rows)) is None and files.rows_of(len(rows) - 1) is not None
    rows = rows[has_header:]
    first, second = (np.array([row[k] if k < len(row) else np.nan for row in rows]) for k in (0, 1))
    # NaN is a name
    is_numbered = np.isfinite(second).any() and not (np.abs(np.diff(first) - 1) > 0).any()
    return require_stamps(second if is_numbered else first, path, files)


def require_stamps(stamps: FloatArray, path: Path, files: NumberedFiles) -> FloatArray:
    """Stamps in seconds read from a file, one for each row of the numbered files it belongs to ``(len(files),)``.

    Bad ones are interpolated between their neighbours (`BadRows`).

    Args:
        stamps: one for each number from 0, one for each row, or one for each file; then those of missing files are
            interpolated.
        path: where they were read.
        files: images, or packets of a GPS/INS.

    Raises:
        SequenceError: there are not as many as files, or too few of them are usable.
    """
    assigned = files.rows_of(len(stamps))
    if assigned is None:
        raise SequenceError(
            f"{path} has {len(stamps)} rows for {len(files.paths)} images: it needs one stamp an image; "
            f"restore the missing images or cut the file to match"
        )
    stamps = _mended_stamps(stamps, path)
    rows, skipped = assigned
    if len(rows) == len(files):
        return stamps[skipped:]
    return np.interp(np.arange(len(files)), rows, stamps)


def _mended_stamps(stamps: FloatArray, path: Path) -> FloatArray:
    bad, rows = BadRows(path, SequenceError), np.arange(1, len(stamps) + 1)
    rows, times = bad.without([(np.isfinite(stamps), "not a time in seconds")], rows, stamps)
    wanted = "times in seconds that increase, one a row"
    order = bad.in_order(times, "stamps", rows, wanted)
    if len(order) == 1:
        bad.say(0, wanted)
    rows, times = np.sort(rows[order]), times[order]
    # at both ends the rate goes on
    beyond, period = (len(stamps), median(np.diff(times) / np.diff(rows)))
    times = np.r_[times[0] - beyond * period, times, times[-1] + beyond * period]
    known = np.r_[rows[0] - beyond, rows, rows[-1] + beyond]
    return np.interp(np.arange(1, len(stamps) + 1), known, times)


def _require_short_gaps(files: NumberedFiles, stamps: FloatArray) -> None:
    """Warn once of missing images, and refuse gaps too long to be interpolated across."""
    for first, last in files.gaps():
        if stamps[last + 1] - stamps[first - 1] > _MAX_GAP_S:
            raise too_long(files, first, last)
    if files.gaps():
        logger.warning(
            "%s: %s; the motion across gaps is interpolated",
            files.paths[0].parent,
            files.describe_gaps(),
        )
