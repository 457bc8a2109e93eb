"""Noise of the steps of a drive besides the covariance of corners, estimated from the drive without ground truth.

The covariance of corners holds for an ideal pinhole. Time stamps, the mount and the lens add errors, which grow with
the camera's rotation jitter and the residual of a step to its neighbours. So the sigmas of each step are inflated by
ratios of the part of these that the noise of corners does not explain.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slam.geometry.robust import mad_sigmas
from slam.geometry.se3 import FloatArray, invert

# sigmas over the jitter and over the residual, by Student's t on KITTI 00 and five simulated drives; ratios of other
# drives cover no better (docs/design/noise-and-the-pose-graph.md)
JITTER_ROTATION, JITTER_DIRECTION = 0.33, 8.5
NEIGHBOUR_ROTATION, NEIGHBOUR_DIRECTION = 0.25, 1.0
_LEAST_STEPS = 20
# a third difference of white noise has 1 + 9 + 9 + 1 times its variance
_THIRD_DIFFERENCE = np.sqrt(20.0)
# residual to the prediction by neighbours under white noise, sigmas
_NEIGHBOUR_RESIDUAL_OF_NOISE = 1.5


@dataclass(frozen=True)
class StepNoise:
    """Sigmas that add in squares: ``rotation`` and ``direction`` ``(3,)`` in radians.

    The direction is of the earlier camera as the later one sees it, where GTSAM perturbs; along it there is no error.
    """

    rotation: FloatArray
    direction: FloatArray


def inflate_step_sigmas(
    T_previous_current: Mapping[int, FloatArray], own: Mapping[int, StepNoise]
) -> dict[int, StepNoise]:
    """The noise of each step of a drive besides that of the corners.

    Args:
        T_previous_current: steps by their order in the drive, neighbours one apart; lengths are not used.
        own: the sigmas by the covariance of corners.
    """
    if not T_previous_current:
        return {}
    rotations = {k: Rotation.from_matrix(T[:3, :3]).as_rotvec() for k, T in T_previous_current.items()}
    directions = {k: _unit(invert(T)[:3, 3]) for k, T in T_previous_current.items()}
    jitter = _unexplained(rotation_jitter(rotations), np.median([own[k].rotation for k in rotations], axis=0))
    noise = {}
    for k in rotations:
        rotation_residual, direction_residual = (
            _unexplained(neighbour_residual(values, k), _NEIGHBOUR_RESIDUAL_OF_NOISE * known)
            for values, known in ((rotations, own[k].rotation), (directions, own[k].direction))
        )
        across = np.sqrt(np.maximum(1.0 - directions[k] ** 2, 0.0))
        jitter_sigma = JITTER_DIRECTION * np.linalg.norm(jitter) * across
        noise[k] = StepNoise(
            rotation=np.hypot(JITTER_ROTATION * jitter, NEIGHBOUR_ROTATION * rotation_residual),
            direction=np.hypot(jitter_sigma, NEIGHBOUR_DIRECTION * direction_residual),
        )
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
    """Absolute residual ``(3,)`` of a step's value to the prediction by its neighbours, 0 without neighbours.

    Predicted by the two steps before, by the two after, and by one on each side; the median of these is robust
    to one bad neighbour.
    """
    lines = [((-1, 0.5), (1, 0.5)), ((-1, 2.0), (-2, -1.0)), ((1, 2.0), (2, -1.0))]
    predicted = [
        sum((weight * values[step + n] for n, weight in line), np.zeros(3))
        for line in lines
        if all(step + n in values for n, _ in line)
    ]
    return np.asarray(np.abs(values[step] - np.median(predicted, axis=0))) if predicted else np.zeros(3)


def _unexplained(seen: FloatArray, known: FloatArray) -> FloatArray:
    """The part of a deviation ``(3,)`` that known sigmas ``(3,)`` do not explain."""
    return np.asarray(np.sqrt(np.maximum(seen**2 - known**2, 0.0)))


def _unit(vector: FloatArray) -> FloatArray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
