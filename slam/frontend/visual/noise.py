"""The noise of steps besides that of their corners, by the jitter of a drive and by neighbours.

The covariance of corners holds for an ideal pinhole. Time stamps, the mount and the lens add
errors, which grow with the camera's rotation jitter and the residual of a step to its neighbours.
So the sigmas of each step are inflated by ratios of the part of these that the noise of corners
does not explain, estimated from the drive without ground truth.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from slam.frames import Ends
from slam.frontend.visual.motion import Motion, links
from slam.geometry.robust import MAD_TO_SIGMA
from slam.geometry.se3 import FloatArray, invert, length_of

# sigmas over the jitter and over the residual, by Student's t on KITTI 00 and five simulated
# drives; ratios of other drives cover no better (docs/design/noise-and-the-pose-graph.md)
JITTER_ROTATION = 0.33
JITTER_DIRECTION = 8.5
NEIGHBOUR_ROTATION = 0.25
NEIGHBOUR_DIRECTION = 1.0
_NEIGHBOUR = np.repeat([NEIGHBOUR_ROTATION, NEIGHBOUR_DIRECTION], 3)
_LEAST_DIFFERENCES = 20
# a third difference of white noise has 1 + 9 + 9 + 1 times its variance
_THIRD_DIFFERENCE = np.sqrt(20.0)
# residual to the prediction by neighbours under white noise, sigmas
_NEIGHBOUR_RESIDUAL_OF_NOISE = 1.5


def step_noise(motions: Mapping[Ends, Motion], frames: int) -> dict[Ends, FloatArray]:
    """The noise of each triangulated step of a drive besides that of the corners, which adds in squares.

    Sigmas ``(6,)`` in radians are of rotation, then of the direction of the earlier camera as the
    later one sees it, where GTSAM perturbs; along it there is no error.

    Args:
        motions: the triangulated steps; lengths are not used.
        frames: of the drive.
    """
    if not motions:
        return {}
    place = {ends: row for row, ends in enumerate(links(motions, frames)) if ends in motions}
    values, own = np.full((2, max(place.values()) + 1, 6), np.nan)  # by their order in the drive
    for ends, row in place.items():
        T_previous_current = motions[ends].relative_pose.T_from_to
        towards = invert(T_previous_current)[:3, 3]
        values[row, :3] = Rotation.from_matrix(T_previous_current[:3, :3]).as_rotvec()
        values[row, 3:] = towards / max(length_of(towards), 1e-12)
        own[row] = motions[ends].corner_sigmas
    jitter = _unexplained(rotation_jitter(values[:, :3]), np.nanmedian(own[:, :3], axis=0))
    residual = _unexplained(neighbour_residual(values), _NEIGHBOUR_RESIDUAL_OF_NOISE * own)
    across = np.sqrt(np.maximum(1.0 - values[:, 3:] ** 2, 0.0))
    turns = np.tile(JITTER_ROTATION * jitter, (len(values), 1))
    by_jitter = np.hstack([turns, JITTER_DIRECTION * np.linalg.norm(jitter) * across])
    noise = np.hypot(by_jitter, _NEIGHBOUR * residual)
    return {ends: noise[row] for ends, row in place.items()}


def rotation_jitter(rotations: FloatArray) -> FloatArray:
    """Sigmas ``(3,)``, radians, of the part of the steps' rotation vectors that no smooth motion explains.

    Third differences remove any rotation that changes evenly; their median is robust to single
    jumps. Zero with few steps. The vectors ``(S, 3)`` are in the order of the drive, NaN where
    unknown.
    """
    third = np.diff(rotations, n=3, axis=0)
    third = third[np.isfinite(third).all(axis=1)]
    if len(third) < _LEAST_DIFFERENCES:
        return np.zeros(3)
    return MAD_TO_SIGMA * np.median(np.abs(third), axis=0) / _THIRD_DIFFERENCE


def neighbour_residual(values: FloatArray) -> FloatArray:
    """Absolute residual ``(S, D)`` of each step's value to the prediction by its neighbours, 0 without neighbours.

    Predicted by the two steps before, by the two after, and by one on each side; the median of
    these is robust to one bad neighbour. Values are in the order of the drive, NaN where unknown.
    """
    padded = np.pad(values, ((2, 2), (0, 0)), constant_values=np.nan)
    earlier, before = padded[:-4], padded[1:-3]
    after, later = padded[3:-1], padded[4:]
    predicted = np.array([0.5 * before + 0.5 * after, 2.0 * before - earlier, 2.0 * after - later])
    predicted[0] = np.where(np.isnan(predicted).all(axis=0), values, predicted[0])
    known = np.isfinite(values[:, 0])
    residual = np.full_like(values, np.nan)
    residual[known] = np.abs(values[known] - np.nanmedian(predicted[:, known], axis=0))
    return residual


def _unexplained(seen: FloatArray, known: FloatArray) -> FloatArray:
    """The part of a deviation ``(D,)`` that known sigmas ``(D,)`` do not explain."""
    return np.sqrt(np.maximum(seen**2 - known**2, 0.0))
