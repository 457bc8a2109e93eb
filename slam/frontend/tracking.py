"""Corners followed from image to image: Shi-Tomasi, pyramidal Lucas-Kanade, checked backwards."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.config import GeometryConfig
from slam.frames import Frame, Image
from slam.se3 import FloatArray

_REMEMBERED = 4
_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01)


@dataclass(frozen=True)
class Tracks:
    """The same ``M`` scene points in two images, pixels ``(M, 2)`` each."""

    previous: FloatArray
    current: FloatArray


class CornerTracker:
    """Follows corners between the frames of one sequence and remembers the last frames' corners."""

    def __init__(self, config: GeometryConfig) -> None:
        self._config = config
        self._seen: OrderedDict[int, _Seen] = OrderedDict()

    def track(self, previous: Frame, current: Frame) -> Tracks:
        """Corners of ``previous`` found again in ``current``."""
        first, second = self._see(previous), self._see(current)
        if first.corners is None:
            first.corners = self._corners(first.grey)
        forward, found = self._flow(first, second, first.corners)
        backward, found_back = self._flow(second, first, forward)
        error = np.abs(backward - first.corners).max(axis=1, initial=0.0)
        height, width = second.grey.shape
        inside = (forward >= 0).all(axis=1) & (forward <= [width - 1, height - 1]).all(axis=1)
        kept = found & found_back & inside & (error < self._config.forward_backward_px)
        return Tracks(first.corners[kept].astype(np.float64), forward[kept].astype(np.float64))

    def _see(self, frame: Frame) -> _Seen:
        seen = self._seen.get(frame.index)
        if seen is None or seen.image is not frame.image:
            grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
            seen = self._seen[frame.index] = _Seen(frame.image, grey)
        self._seen.move_to_end(frame.index)
        while len(self._seen) > _REMEMBERED:
            self._seen.popitem(last=False)
        return seen

    def _corners(self, grey: NDArray[np.uint8]) -> NDArray[np.float32]:
        config = self._config
        corners = cv2.goodFeaturesToTrack(
            grey, config.max_corners, config.corner_quality, config.corner_spacing_px, blockSize=5
        )
        return np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)

    def _flow(
        self, first: _Seen, second: _Seen, points: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        if len(points) == 0:
            return points, np.zeros(0, dtype=bool)
        side = self._config.window_px
        moved, status, _ = cv2.calcOpticalFlowPyrLK(
            first.grey,
            second.grey,
            points.reshape(-1, 1, 2),
            None,
            winSize=(side, side),
            maxLevel=self._config.pyramid_levels,
            criteria=_CRITERIA,
        )
        return moved.reshape(-1, 2), status.ravel().astype(bool)


@dataclass
class _Seen:
    image: Image
    grey: NDArray[np.uint8]
    corners: NDArray[np.float32] | None = None
