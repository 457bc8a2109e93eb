"""A synthetic street, the input where no images are given: a road between two textured walls."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.readers.kitti_calibration import CAMERA_HEIGHT_M

_HALF_WIDTH_M = 7.0
_FOCAL_SHARE = 0.58  # focal length over image width, as KITTI's


def street_snippet(frames: int, height: int, width: int, step_m: float = 1.0) -> list[NDArray[np.uint8]]:
    """Consecutive views of a straight drive, in time order.

    Args:
        frames: how many.
        height: of each view, pixels.
        width: of each view, pixels.
        step_m: forward motion between views.

    Returns:
        Images ``(height, width, 3)`` uint8 RGB.
    """
    return [_view(height, width, k * step_m) for k in range(frames)]


def _view(height: int, width: int, z_m: float) -> NDArray[np.uint8]:
    v, u = np.mgrid[:height, :width]
    ray_x = (u - (width - 1) / 2) / (_FOCAL_SHARE * width)
    ray_y = (v - (height - 1) / 2) / (_FOCAL_SHARE * width)
    to_road = CAMERA_HEIGHT_M / np.maximum(ray_y, 1e-6)  # z-depth in metres
    to_wall = _HALF_WIDTH_M / np.maximum(np.abs(ray_x), 1e-6)
    depth = np.minimum(to_road, to_wall)
    x, y, z = ray_x * depth, ray_y * depth, z_m + depth
    wall = to_wall < to_road
    sky = wall & (y < -6 - 2 * np.sin(np.floor(z / 9) * 2.4))
    lane = (np.abs(np.abs(x) - 2) < 0.12) & (np.mod(z, 6) < 3)
    window = (np.mod(z, 3) < 1.2) & (np.mod(y, 2.5) < 1.3)
    shade = np.where(wall, 0.62 - 0.3 * window, 0.33 + 0.5 * lane) + 0.1 * _grain(np.where(wall, y, x), z)
    shade = np.where(sky, 0.92, shade / (1 + depth / 300))
    tint = np.where(sky[..., None], [0.85, 0.93, 1.0], np.where(wall[..., None], [1.0, 0.9, 0.8], [0.95, 0.97, 1.0]))
    return np.asarray(np.rint(255 * np.clip(shade[..., None] * tint, 0, 1)), dtype=np.uint8)


def _grain(across: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.float64]:
    """A texture in [-1, 1] fixed to the world."""
    waves = [np.sin(a * across + b * along + a * b) for a, b in ((2.1, 1.3), (5.3, -3.1), (-9.7, 7.9), (3.3, 0.4))]
    texture: NDArray[np.float64] = np.mean(waves, axis=0)
    return texture
