"""Depth maps sampled between their pixels."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import DepthMap

_SURFACE_STEP = 0.12  # relative depth step between neighbouring pixels of one surface
_TIE_PX = np.float32(1e-3)  # of two pixels equally near that right and below, on a road the nearer one


def sampled_depth(depth: DepthMap, u: NDArray[np.float32], v: NDArray[np.float32]) -> DepthMap:
    """Depth of a map ``(H, W)``, not positive or not finite where unknown, at columns and rows ``(h, w)``.

    Linear in 1/depth, which is exact on planes, where the four pixels around are known and of one surface; elsewhere
    that of the nearest pixel, so that edges are not smeared and unknown depth does not spread.
    """
    known = np.isfinite(depth) & (depth > 0)
    inverse = np.zeros(depth.shape, np.float32)
    np.divide(1, depth, out=inverse, where=known)
    pixels = np.ones((2, 2), np.uint8)  # this one, and those right and below
    column, row = np.floor(u), np.floor(v)
    least, most = (_nearest(bound(inverse, pixels, anchor=(0, 0)), column, row) for bound in (cv2.erode, cv2.dilate))
    between = cv2.remap(inverse, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    sampled = _nearest(depth, u + _TIE_PX, v + _TIE_PX)
    is_one_surface = (least > 0) & (most <= (1 + _SURFACE_STEP) * least)
    np.divide(1, between, out=sampled, where=is_one_surface)
    return sampled


def resized_depth(depth: DepthMap, width: int, height: int) -> DepthMap:
    """The depth map ``(height, width)`` of an image resized to so many pixels, as `sampled_depth`."""
    u, v = (
        ((np.arange(to, dtype=np.float32) + 0.5) * (of / to) - 0.5).astype(np.float32)
        for to, of in ((width, depth.shape[1]), (height, depth.shape[0]))
    )
    return sampled_depth(depth, *np.meshgrid(u, v))


def _nearest(values: NDArray[np.float32], u: NDArray[np.float32], v: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.remap(values, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE), np.float32)
