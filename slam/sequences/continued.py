"""A continued drive: earlier frames, of which only stamps are kept, and the frames that follow."""

from __future__ import annotations

import logging

import numpy as np

from erfsfm.common.readers.frame_range import EVERYTHING, FrameRange
from slam.frames import Frame, Intrinsics, Sequence
from slam.geometry.se3 import FloatArray, invert
from slam.runtime.errors import MissingFrameError, SequenceError
from slam.sequences.excerpt import Excerpt
from slam.sequences.images import MAX_GAP_FRAMES
from slam.sequences.recording import MAX_GAP_S, require_frame

logger = logging.getLogger(__name__)

_ROUNDING_PX = 0.01
_SIMULATED = "simulated/"
_NUMBERED = ("kitti_", _SIMULATED)  # of names whose frame numbers are those of the recording


class Continued:
    """Earlier frames, then all of another sequence of the same camera. LiDAR scans are not used.

    Frames of the recording between the last earlier one and the first that follows are missing frames.
    """

    T_camera_lidar: FloatArray | None = None

    def __init__(
        self,
        name: str,
        intrinsics: Intrinsics,
        stamps: FloatArray,
        camera_height_m: float | None,
        reference: FloatArray | None,
        sources: tuple[str, ...],
        following: Sequence,
    ) -> None:
        """Append a sequence.

        Args:
            name, intrinsics, stamps, camera_height_m, reference: of the earlier frames, as of a `Sequence`.
            sources: their ``provenance``.
            following: stamps that are not after the earlier ones are shifted to be.

        Raises:
            SequenceError: another camera, another recording, frames before the last earlier one, or a gap longer
                than 100 frames or 10 seconds.
        """
        if not _same_camera(following.intrinsics, intrinsics):
            raise SequenceError(
                f"{following.name} was taken with another camera, {_described(following.intrinsics)}, than the frames "
                f"before it, {_described(intrinsics)}: give frames of the same camera and size"
            )
        self.name, self.intrinsics, self.camera_height_m = name, intrinsics, camera_height_m
        self.before = len(stamps)
        self._missing = missing_between(sources, following.provenance())
        if _same_world(sources, following.provenance()):
            self._missing = _missing_by_clock(name, stamps, following.stamps)
        self.following, self._sources = following, sources
        self.first = self.before + self._missing  # of the frames that follow
        self.stamps = _joined_stamps(stamps, self._missing, following.stamps)
        self._require_short_gap()
        self.reference = _joined_poses(stamps, reference, self._missing, following)

    def __len__(self) -> int:
        """Number of frames, with the earlier and the missing ones."""
        return len(self.stamps)

    def frame(self, index: int) -> Frame:
        """Read one of the frames that follow.

        Raises:
            MissingFrameError: it is between the earlier frames and those that follow.
            SequenceError: its image cannot be read, or it is an earlier one.
        """
        require_frame(self.name, index, len(self))
        if index < self.before:
            raise SequenceError(f"frame {index} of {self.name} is of an earlier run, which keeps no images")
        if index < self.first:
            raise MissingFrameError(f"frame {index} of {self.name} is missing between two runs")
        return Frame(index, float(self.stamps[index]), self.following.frame(index - self.first).image)

    def has_scan(self, index: int) -> bool:
        """False: scans of earlier frames are not kept."""
        return False

    def scan(self, index: int) -> FloatArray:
        """Always ``SequenceError``: scans of earlier frames are not kept."""
        raise SequenceError(f"frame {index} of {self.name} has no scan: those of earlier frames are not kept")

    def provenance(self) -> tuple[str, ...]:
        """Names of all parts, as in the leak record of a checkpoint."""
        return (*self._sources, *self.following.provenance())

    def _require_short_gap(self) -> None:
        if not self._missing:
            return
        seconds = float(self.stamps[self.first] - self.stamps[self.before - 1])
        between = f"{self._missing} frames between {', '.join(self._sources)} and {self.following.provenance()[0]}"
        if self._missing > MAX_GAP_FRAMES or seconds > MAX_GAP_S:
            raise SequenceError(
                f"{between} are missing ({seconds:.1f} s), too long a gap to interpolate: give frames that follow "
                f"sooner, with --frames A:B, or run them on their own"
            )
        logger.warning("%s are missing: the motion across them is interpolated", between)


def recording_of(sequence: Sequence) -> tuple[Sequence, int, int]:
    """The recording of a sequence, which frame of it frame 0 is, and from which frame on the sequence is of it."""
    first = 0
    if isinstance(sequence, Continued):
        first, sequence = sequence.first, sequence.following
    base, start = (sequence.base, sequence.start) if isinstance(sequence, Excerpt) else (sequence, 0)
    return base, start - first, first


def unused_scans(sequence: Sequence) -> str:
    """Why the LiDAR scans of a sequence are not used; empty where they are, or it has none."""
    following = sequence.following if isinstance(sequence, Continued) else None
    has_scans = following is not None and any(following.has_scan(k) for k in range(len(following)))
    return "LiDAR scans are not used where a drive continues another folder" if has_scans else ""


def missing_between(before: tuple[str, ...], following: tuple[str, ...]) -> int:
    """Number of frames of a recording between the earlier ones and the new ones, by their leak-record names.

    Names of simulated worlds have no frame numbers: their stamps tell. Folders with other names are assumed to follow,
    with a warning.

    Raises:
        SequenceError: other recordings, or frames from before the last one.
    """
    seen = [FrameRange.parse(name) for name in before]
    ends: list[tuple[int, str]] = []
    for name in following:
        wanted = FrameRange.parse(name)
        same = [span.counted_in(wanted.recording) for span in seen]
        if wanted.stop == EVERYTHING and any(span is not None for span in same):
            return 0
        ends += [(wanted.start - span.stop, name) for span in same if span is not None]
    if not ends:
        if not any(name.startswith(_NUMBERED) for name in following):
            logger.warning("%s is assumed to follow %s without a gap", ", ".join(following), ", ".join(before))
            return 0
        raise SequenceError(
            f"{', '.join(following)} cannot continue {', '.join(before)}: it is another recording; give the frames "
            f"that follow, or run it on its own"
        )
    missing, name = min(ends)
    if missing < 0:
        raise SequenceError(
            f"{name} does not come after {', '.join(before)}: give the frames that follow, with --frames A:B"
        )
    return missing


def _same_world(before: tuple[str, ...], following: tuple[str, ...]) -> bool:
    """Whether both are frames of one simulated world, which have one clock."""
    return before[-1:] == following[:1] and following[0].startswith(_SIMULATED)


def _missing_by_clock(name: str, stamps: FloatArray, following: FloatArray) -> int:
    """Number of frames of one clock between the last stamp and the first that follows.

    A clock that begins again is that of a copy, and assumed to follow, with a warning.

    Raises:
        SequenceError: the frames that follow begin before the last one.
    """
    if following[0] == 0:
        logger.warning("stamps of %s begin again: its frames are assumed to follow without a gap", name)
        return 0
    periods = np.diff(np.concatenate([stamps[-2:], following[:2]]))[[0, -1]]
    missing = round(float(following[0] - stamps[-1]) / float(periods.min())) - 1
    if missing < 0:
        raise SequenceError(
            f"{name}: the frames that follow begin at {following[0]:g} s, before the last one at {stamps[-1]:g} s: "
            "give the frames that follow, with --frames A:B"
        )
    return missing


def _same_camera(a: Intrinsics, b: Intrinsics) -> bool:
    """The same camera, up to the rounding of calibration files."""
    return (a.width, a.height) == (b.width, b.height) and bool(np.abs(a.K - b.K).max() < _ROUNDING_PX)


def _described(camera: Intrinsics) -> str:
    return f"{camera.width} x {camera.height} pixels, fx {camera.fx:.2f}, fy {camera.fy:.2f}"


def _joined_stamps(stamps: FloatArray, missing: int, following: FloatArray) -> FloatArray:
    """All stamps, those of missing frames evenly between their neighbours."""
    after = _after(stamps, missing, following)
    between = np.linspace(stamps[-1], after[0], missing + 2)[1:-1]
    return np.concatenate([stamps, between, after])


def _after(stamps: FloatArray, missing: int, following: FloatArray) -> FloatArray:
    if following[0] > stamps[-1]:
        return following
    interval = float(np.median(np.diff(np.concatenate([stamps, stamps[-1] + following - following[0]]))))
    logger.info(
        "stamps of the frames that follow begin at %.3f s: shifted to come after %.3f s", following[0], stamps[-1]
    )
    return np.asarray(following - following[0] + stamps[-1] + (missing + 1) * max(interval, 1e-3))


def _joined_poses(
    stamps: FloatArray, reference: FloatArray | None, missing: int, following: Sequence
) -> FloatArray | None:
    """True poses of all frames, where both parts are of one recording with only missing frames between."""
    if reference is None or not isinstance(following, Excerpt) or following.start <= missing:
        return None
    last = following.start - missing - 1
    T_base, stamps_base = following.base.reference, following.base.stamps
    if T_base is None or stamps_base[last] != stamps[-1]:
        return None
    T_last_later = invert(T_base[last]) @ T_base[last + 1 : following.stop]
    T_first_camera: FloatArray = np.concatenate([reference, reference[-1] @ T_last_later])
    return T_first_camera
