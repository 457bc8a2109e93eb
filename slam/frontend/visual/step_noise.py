"""Noise of the steps of a drive besides the covariance of corners, estimated from the drive without ground truth.

The covariance of corners holds for an ideal pinhole. Time stamps, the mount and the lens add errors, which grow with
the camera's rotation jitter and the residual of a step to its neighbours. So the sigmas of each step are inflated by
ratios of the part of these that the noise of corners does not explain.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from slam.geometry.robust import mad_sigmas
from slam.geometry.se3 import FloatArray, invert

# sigmas over the jitter and over the residual, by Student's t on KITTI 00 and five simulated drives; ratios of other
# drives cover no better (docs/design/noise-and-the-pose-graph.md)
JITTER_ROTATION, JITTER_DIRECTION = 0.33, 8.5
NEIGHBOUR_ROTATION, NEIGHBOUR_DIRECTION = 0.25, 1.0
_NEIGHBOUR = np.repeat([NEIGHBOUR_ROTATION, NEIGHBOUR_DIRECTION], 3)
_LEAST_STEPS = 20
# a third difference of white noise has 1 + 9 + 9 + 1 times its variance
_THIRD_DIFFERENCE = np.sqrt(20.0)
# residual to the prediction by neighbours under white noise, sigmas
_NEIGHBOUR_RESIDUAL_OF_NOISE = 1.5


def inflate_step_sigmas(
    T_previous_current: Mapping[int, FloatArray], own: Mapping[int, FloatArray]
) -> dict[int, FloatArray]:
    """The noise of each step of a drive besides that of the corners, which adds in squares.

    Sigmas ``(6,)`` in radians are of rotation, then of the direction of the earlier camera as the later one sees it,
    where GTSAM perturbs; along it there is no error.

    Args:
        T_previous_current: steps by their order in the drive, neighbours one apart; lengths are not used.
        own: the sigmas by the covariance of corners.
    """
    if not T_previous_current:
        return {}
    steps = {
        k: np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), _unit(invert(T)[:3, 3])])
        for k, T in T_previous_current.items()
    }
    jitter = rotation_jitter({k: step[:3] for k, step in steps.items()})
    jitter = _unexplained(jitter, np.median([own[k][:3] for k in steps], axis=0))
    noise = {}
    for k, step in steps.items():
        residual = _unexplained(neighbour_residual(steps, k), _NEIGHBOUR_RESIDUAL_OF_NOISE * own[k])
        across = np.sqrt(np.maximum(1.0 - step[3:] ** 2, 0.0))
        by_jitter = [JITTER_ROTATION * jitter, JITTER_DIRECTION * np.linalg.norm(jitter) * across]
        noise[k] = np.hypot(np.concatenate(by_jitter), _NEIGHBOUR * residual)
    return noise


def rotation_jitter(rotations: Mapping[int, FloatArray]) -> FloatArray:
    """Sigmas ``(3,)``, radians, of the part of the steps' rotation vectors that no smooth motion explains.

    Third differences remove any rotation that changes evenly; their median is robust to single jumps. Zero with few
    steps.
    """
    steps = sorted(k for k in rotations if all(k + n in rotations for n in range(1, 4)))
    if len(steps) < _LEAST_STEPS:
        return np.zeros(3)
    third = np.array([rotations[k + 3] - 3 * rotations[k + 2] + 3 * rotations[k + 1] - rotations[k] for k in steps])
    return np.asarray(mad_sigmas(third) / _THIRD_DIFFERENCE)


def neighbour_residual(values: Mapping[int, FloatArray], step: int) -> FloatArray:
    """Absolute residual ``(D,)`` of a step's value to the prediction by its neighbours, 0 without neighbours.

    Predicted by the two steps before, by the two after, and by one on each side; the median of these is robust
    to one bad neighbour.
    """
    lines = [((-1, 0.5), (1, 0.5)), ((-1, 2.0), (-2, -1.0)), ((1, 2.0), (2, -1.0))]
    predicted = [
        sum((weight * values[step + n] for n, weight in line), np.zeros_like(values[step]))
        for line in lines
        if all(step + n in values for n, _ in line)
    ]
    return np.abs(values[step] - (np.median(predicted, axis=0) if predicted else values[step]))


def _unexplained(seen: FloatArray, known: FloatArray) -> FloatArray:
    """The part of a deviation ``(D,)`` that known sigmas ``(D,)`` do not explain."""
    return np.asarray(np.sqrt(np.maximum(seen**2 - known**2, 0.0)))


def _unit(vector: FloatArray) -> FloatArray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
