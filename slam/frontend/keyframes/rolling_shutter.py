"""Corners of a rolling shutter, moved to where one moment would show them.

Rows are read one after another while the camera turns. What moves the image as a whole from the frame before is taken
as a turn at a steady rate, also where it is in part a translation: at the usual distance both move corners alike.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from slam.frames import Intrinsics
from slam.frontend.tracking import Pixels
from slam.geometry.epipolar import rotation_between
from slam.geometry.se3 import FloatArray

_Places = TypeVar("_Places", Pixels, FloatArray)
_LEAST_CORNERS = 20
_ITERATIONS = 3


def in_middle_row(pixels: _Places, turn: FloatArray, intrinsics: Intrinsics) -> _Places:
    """Pixels ``(M, 2)`` of an image as the camera sees them when the middle row is read.

    Args:
        pixels: as the image has them.
        turn: of the camera, rotation vector a second ``(3,)``, as of ``R_current_previous``.
        intrinsics: of the image.
    """
    if not intrinsics.readout_s or not len(pixels):
        return pixels
    seconds = intrinsics.readout_s * ((pixels[:, 1] + 0.5) / intrinsics.height - 0.5)
    rays = Rotation.from_rotvec(-seconds[:, None] * turn).apply(intrinsics.rays(pixels.astype(np.float64)))
    return intrinsics.project(rays).astype(pixels.dtype)


def measured_turn(
    before: Pixels | FloatArray, pixels: Pixels, seconds: float, turn: FloatArray, intrinsics: Intrinsics
) -> FloatArray:
    """The turn a second ``(3,)`` between two images; zero with few corners.

    Args:
        before: corners in the image before ``(M, 2)``, when its middle row was read.
        pixels: the same corners in this image ``(M, 2)``, as it has them.
        seconds: between the images.
        turn: the one before, to start from.
        intrinsics: of both images.
    """
    if len(pixels) < _LEAST_CORNERS or seconds <= 0:
        return np.zeros(3)
    rays_before = intrinsics.rays(before.astype(np.float64))
    for _ in range(_ITERATIONS):
        rays = intrinsics.rays(in_middle_row(pixels, turn, intrinsics).astype(np.float64))
        turn = Rotation.from_matrix(rotation_between(rays_before, rays)).as_rotvec() / seconds
    return turn
