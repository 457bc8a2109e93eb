"""How far corners err on this drive, as the drive itself shows: no truth is looked at.

Corners promise sigmas that hold where the camera is all that errs. On the road more goes wrong than they know of -
stamps, the mount, whatever is not a pinhole - and it goes wrong in proportion to how the camera shakes from step to
step. So the sigmas are widened by shares of that shake, and the lengths by how far the road's and the points' own
lengths disagree. The shares in ``GeometryConfig`` were measured once, on the first 300 frames of KITTI 00, 02 and 05
and on two simulated streets.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slam.config import GeometryConfig
from slam.se3 import FloatArray

_MAD_TO_SIGMA = 1.4826
_LEAST_STEPS = 20
# a third difference of white noise has 1 + 9 + 9 + 1 times its variance
_THIRD_DIFFERENCE = np.sqrt(20.0)


@dataclass(frozen=True)
class DriveNoise:
    """Sigmas to add in squares: ``rotation`` ``(3,)`` and ``direction`` in radians, ``length`` as a share."""

    rotation: FloatArray
    direction: float
    length: float


def drive_noise(
    T_previous_current: Mapping[int, FloatArray], length_spread: float, config: GeometryConfig
) -> DriveNoise:
    """The noise of a drive's steps.

    Args:
        T_previous_current: steps that corners measured, by their first frame; only their rotations are used.
        length_spread: relative sigma of single measurements of length.
        config: the shares.
    """
    shake = rotation_shake(T_previous_current)
    return DriveNoise(
        config.shake_rotation_share * shake,
        config.shake_direction_share * float(np.linalg.norm(shake)),
        float(np.hypot(config.length_floor_share, config.length_spread_share * length_spread)),
    )


def rotation_shake(T_previous_current: Mapping[int, FloatArray]) -> FloatArray:
    """What of the steps' rotation vectors no smooth motion explains: sigmas ``(3,)``, radians, 0 with few steps.

    Third differences remove any turn that changes evenly; their middle size withstands jolts.
    """
    steps = sorted(k for k in T_previous_current if all(k + n in T_previous_current for n in range(1, 4)))
    if len(steps) < _LEAST_STEPS:
        return np.zeros(3)
    turned = {k: Rotation.from_matrix(T[:3, :3]).as_rotvec() for k, T in T_previous_current.items()}
    third = np.array([turned[k + 3] - 3 * turned[k + 2] + 3 * turned[k + 1] - turned[k] for k in steps])
    return np.asarray(_MAD_TO_SIGMA * np.median(np.abs(third), axis=0) / _THIRD_DIFFERENCE)
