"""How a camera moved where no point carries the unit of a map, in the unit of learned depth."""

from __future__ import annotations

import numpy as np

from slam.frames import KEYFRAME_SOURCE, RelativePose
from slam.geometry.se3 import FloatArray, make

_IMAGE_SIGMA, _IMAGE_LENGTH = np.deg2rad(0.5), 0.03  # radians, depths
_ROTATION_SIGMA, _LENGTH_SIGMA = np.deg2rad(0.1), 0.01  # least sigmas, radians and depths
_DEPTH_SIGMA = 0.2  # of a length by learned depth, over it


def turn_by_points(first: int, last: int, T_first_last: FloatArray, depth: float) -> RelativePose:
    """Between two cameras that share points without parallax, at a usual ``depth``."""
    length = _LENGTH_SIGMA * depth + _DEPTH_SIGMA * float(np.linalg.norm(T_first_last[:3, 3]))
    return RelativePose(first, last, T_first_last, np.repeat([_ROTATION_SIGMA, length], 3), KEYFRAME_SOURCE)


def turn_by_image(first: int, last: int, R_last_first: FloatArray, depth: float) -> RelativePose:
    """Between two frames whose whole images show a turn, at a usual ``depth``."""
    sigmas = np.repeat([_IMAGE_SIGMA, _IMAGE_LENGTH * depth], 3)
    return RelativePose(first, last, make(R_last_first.T, np.zeros(3)), sigmas, KEYFRAME_SOURCE)
