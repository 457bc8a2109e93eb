"""A drive that goes on: frames that were looked at before, of which stamps are left, and those that follow."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from slam.errors import SequenceError
from slam.frames import Frame, Intrinsics, Sequence
from slam.se3 import FloatArray, invert
from slam.sequences.excerpt import Excerpt
from slam.sequences.recording import require_frame

logger = logging.getLogger(__name__)

_ROUNDING_PX = 0.01


class Continued:
    """So many frames of before, then all of another sequence of the same camera. LiDAR scans are not followed."""

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
            name, intrinsics, stamps, camera_height_m, reference: of the frames of before, as of a `Sequence`.
            sources: their ``provenance``.
            following: where its stamps do not come after the last one of before, they are moved there.

        Raises:
            SequenceError: another camera.
        """
        if not _alike(following.intrinsics, intrinsics):
            raise SequenceError(
                f"{following.name} was taken with another camera, {_described(following.intrinsics)}, than the frames "
                f"before it, {_described(intrinsics)}: give frames of the same camera and size"
            )
        self.name, self.intrinsics, self.camera_height_m = name, intrinsics, camera_height_m
        self.before = len(stamps)
        self._following, self._sources = following, sources
        self.stamps = np.concatenate([stamps, _after(stamps, following.stamps)])
        self.reference = _joined(stamps, reference, following)

    def __len__(self) -> int:
        """Number of frames, those of before among them."""
        return len(self.stamps)

    def frame(self, index: int) -> Frame:
        """Read one of the frames that follow; ``SequenceError`` where its image cannot be read, or is of before."""
        require_frame(self.name, index, len(self))
        if index < self.before:
            raise SequenceError(f"frame {index} of {self.name} was looked at before and is not kept")
        return Frame(index, float(self.stamps[index]), self._following.frame(index - self.before).image)

    def scan_path(self, index: int) -> Path | None:
        """None: scans of before are not kept."""
        return None

    def provenance(self) -> tuple[str, ...]:
        """Names of all that it is made of, as the leak record of a checkpoint writes them."""
        return (*self._sources, *self._following.provenance())


def _alike(a: Intrinsics, b: Intrinsics) -> bool:
    """The same camera, up to the rounding of calibration files."""
    return (a.width, a.height) == (b.width, b.height) and bool(np.abs(a.K - b.K).max() < _ROUNDING_PX)


def _described(camera: Intrinsics) -> str:
    return f"{camera.width} x {camera.height} pixels, fx {camera.fx:.2f}, fy {camera.fy:.2f}"


def _after(stamps: FloatArray, following: FloatArray) -> FloatArray:
    if following[0] > stamps[-1]:
        return following
    interval = float(np.median(np.diff(np.concatenate([stamps, stamps[-1] + following - following[0]]))))
    logger.info(
        "stamps of the frames that follow begin at %.3f s: moved to come after %.3f s", following[0], stamps[-1]
    )
    return np.asarray(following - following[0] + stamps[-1] + max(interval, 1e-3))


def _joined(stamps: FloatArray, reference: FloatArray | None, following: Sequence) -> FloatArray | None:
    """True poses of all frames, where both parts are of one recording and the second follows on the first."""
    if reference is None or not isinstance(following, Excerpt) or following.start == 0:
        return None
    T_base, stamps_base = following.base.reference, following.base.stamps
    if T_base is None or stamps_base[following.start - 1] != stamps[-1]:
        return None
    T_last_following = invert(T_base[following.start - 1]) @ T_base[following.start : following.stop]
    T_first_camera: FloatArray = np.concatenate([reference, reference[-1] @ T_last_following])
    return T_first_camera
