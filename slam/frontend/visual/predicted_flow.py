"""Optical flow of a static scene by learned depth and a motion: a start for tracking corners, and depth carried along.

From a moving car a window on the road is stretched by a fifth from frame to frame, one on a near wall by a tenth.
Lucas-Kanade shifts windows without stretching them. It then locks onto whatever part of a window has most texture:
single corners have errors of half a pixel, and those on the road all upwards, which resembles a pitching camera
(``docs/design/visual-front-end.md``). Warping the later image back by the predicted flow removes the stretch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import DepthMap, Grey, Intrinsics
from slam.geometry.epipolar import UnitRelativePose
from slam.geometry.se3 import FloatArray

_NEAREST = 1e-6
_INVERSIONS = 2
_DEPTH_WIDTH_PX = 400
_GRID_PX = 3  # the flow is computed at every third pixel: learned depth has no finer detail


@dataclass(frozen=True, eq=False)
class PredictedFlow:
    """Flow of the pixels of an image under a motion (``unit_pose``, ``length``) in a static scene.

    ``length`` and ``depth_previous`` ``(H, W)`` are in one unit; pixels without depth are taken as infinitely far.
    """

    unit_pose: UnitRelativePose
    length: float
    depth_previous: DepthMap
    intrinsics: Intrinsics

    @classmethod
    def of(cls, T_previous_current: FloatArray, depth_previous: DepthMap, intrinsics: Intrinsics) -> Self | None:
        """By a pose in the unit of the depth; None where it has no length."""
        known = UnitRelativePose.of(T_previous_current)
        return None if known is None else cls(*known, depth_previous, intrinsics)

    def warp_back(self, current: Grey) -> Grey:
        """The later image ``(H, W)`` warped to the earlier one, equal to it where the prediction is right."""
        return np.asarray(cv2.remap(current, self._current, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))

    def in_current(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Where pixels ``(M, 2)`` of the warped image lie in the later one."""
        if len(pixels) == 0:
            return pixels
        u, v = np.ascontiguousarray(pixels.T)
        moved = cv2.remap(self._current, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(moved, dtype=np.float32).reshape(-1, 2)

    def depth_current(self) -> DepthMap:
        """Z-depth ``(H, W)`` of the later image, of the surfaces that the earlier one shows; NaN where unknown.

        Of large images it is computed at about the size at which networks see them.
        """
        height, width = self.depth_previous.shape
        ratio = width // _DEPTH_WIDTH_PX
        if ratio > 1:
            size = width // ratio, max(height // ratio, 1)
            depth = cv2.resize(self.depth_previous, size, interpolation=cv2.INTER_NEAREST_EXACT)
            small = PredictedFlow(self.unit_pose, self.length, np.asarray(depth), self.intrinsics.resized(*size))
            later = small.depth_current()
            return np.asarray(cv2.resize(later, (width, height), interpolation=cv2.INTER_NEAREST_EXACT))
        grid = _pixels(self.intrinsics)
        flow = self._current - grid
        before = grid - flow
        for _ in range(_INVERSIONS - 1):  # fixed point: a pixel less the flow that ends there
            before = grid - cv2.remap(flow, before, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        turned, moved = self._projection
        x, y = before[..., 0], before[..., 1]
        depth = cv2.remap(self.depth_previous, before, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        later = depth * (turned[2, 0] * x + turned[2, 1] * y + turned[2, 2]) + moved[2]
        return np.where((depth > 0) & (later > 0), later, np.float32(np.nan))

    @cached_property
    def _projection(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """``K R K^-1`` ``(3, 3)`` and ``K t`` ``(3,)``."""
        K = self.intrinsics.K
        turned = K @ self.unit_pose.R_current_previous @ np.linalg.inv(K)
        return turned.astype(np.float32), (self.length * K @ self.unit_pose.direction).astype(np.float32)

    @cached_property
    def _current(self) -> NDArray[np.float32]:
        """Pixels of the later image ``(H, W, 2)`` by those of the earlier one: ``K R K^-1 x + K t / z``."""
        height, width = self.depth_previous.shape
        turned, moved = self._projection
        rows, columns = max(height // _GRID_PX, 1), max(width // _GRID_PX, 1)
        depth = cv2.resize(self.depth_previous, (columns, rows), interpolation=cv2.INTER_NEAREST_EXACT)
        v = ((np.arange(rows) + 0.5) * height / rows - 0.5).astype(np.float32)
        u = ((np.arange(columns) + 0.5) * width / columns - 0.5).astype(np.float32)
        near = cv2.divide(1.0, depth)
        near[~(depth > 0)] = 0.0
        x, y, z = (
            cv2.scaleAdd(near, float(shift), np.add.outer(row[1] * v + row[2], row[0] * u))
            for row, shift in zip(turned, moved, strict=True)
        )
        ahead = cv2.max(z, _NEAREST)
        flow = cv2.merge([cv2.divide(x, ahead) - u, cv2.divide(y, ahead) - v[:, None]])
        return np.asarray(cv2.resize(flow, (width, height)) + _pixels(self.intrinsics))


@lru_cache(maxsize=2)
def _pixels(intrinsics: Intrinsics) -> NDArray[np.float32]:
    """Each pixel's own column and row ``(H, W, 2)``."""
    return intrinsics.pixel_grid().astype(np.float32)
