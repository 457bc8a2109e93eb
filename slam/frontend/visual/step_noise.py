"""How far corners err on this drive and at this step, as the drive itself shows: no truth is looked at.

Corners promise sigmas that hold where the camera is all that errs. On the road more goes wrong than they know of -
stamps, the mount, whatever is not a pinhole - and it goes wrong in proportion to how the camera shakes, how it turns,
and where a step does not fit the steps beside it. So the sigmas of each step are widened by shares of what of these the
corners' own noise does not explain. The shares in ``GeometryConfig`` were fitted once
(``docs/design/noise-and-the-pose-graph.md``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slam.config import GeometryConfig
from slam.robust import mad_sigmas
from slam.se3 import FloatArray, invert

_LEAST_STEPS = 20
# a third difference of white noise has 1 + 9 + 9 + 1 times its variance
_THIRD_DIFFERENCE = np.sqrt(20.0)
# white noise makes a step differ from what its neighbours foretell by so many of its sigmas
_NEIGHBOUR_RESIDUAL_OF_NOISE = 1.5


@dataclass(frozen=True)
class StepNoise:
    """Sigmas that add in squares: ``rotation`` and ``direction`` ``(3,)`` in radians.

    The direction is of the earlier camera as the later one sees it, where GTSAM perturbs; along it there is no error.
    """

    rotation: FloatArray
    direction: FloatArray


def inflate_step_sigmas(
    T_previous_current: Mapping[int, FloatArray], own: Mapping[int, StepNoise], config: GeometryConfig
) -> dict[int, StepNoise]:
    """The noise of each step of a drive beside what its corners know of.

    Args:
        T_previous_current: steps that corners measured, by their first frame; lengths are not looked at.
        own: the sigmas that the corners of each step promise.
        config: the shares.
    """
    if not T_previous_current:
        return {}
    turned = {k: Rotation.from_matrix(T[:3, :3]).as_rotvec() for k, T in T_previous_current.items()}
    along = {k: _unit(invert(T)[:3, 3]) for k, T in T_previous_current.items()}
    shake = _beyond(rotation_jitter(turned), np.median([own[k].rotation for k in turned], axis=0))
    noise = {}
    for k, turn in turned.items():
        rotation = [config.jitter_rotation_ratio * shake, config.turn_rotation_ratio * turn]
        jolted, swerved = (
            _beyond(neighbour_residual(values, k), _NEIGHBOUR_RESIDUAL_OF_NOISE * known)
            for values, known in ((turned, own[k].rotation), (along, own[k].direction))
        )
        rotation.append(config.neighbour_rotation_ratio * jolted)
        aside = config.jitter_direction_ratio * np.linalg.norm(shake) * np.sqrt(np.maximum(1.0 - along[k] ** 2, 0.0))
        direction = np.hypot(aside, config.neighbour_direction_ratio * swerved)
        noise[k] = StepNoise(np.linalg.norm(rotation, axis=0), direction)
    return noise


def rotation_jitter(turned: Mapping[int, FloatArray]) -> FloatArray:
    """What of the steps' rotation vectors no smooth motion explains: sigmas ``(3,)``, radians, 0 with few steps.

    Third differences remove any turn that changes evenly; their middle size withstands jolts.
    """
    steps = sorted(k for k in turned if all(k + n in turned for n in range(1, 4)))
    if len(steps) < _LEAST_STEPS:
        return np.zeros(3)
    third = np.array([turned[k + 3] - 3 * turned[k + 2] + 3 * turned[k + 1] - turned[k] for k in steps])
    return np.asarray(mad_sigmas(third) / _THIRD_DIFFERENCE)


def neighbour_residual(values: Mapping[int, FloatArray], step: int) -> FloatArray:
    """How far a step's value ``(3,)`` lies from what the steps beside it foretell, 0 where none do.

    Foretold by the two steps before, by the two after, and by one on each side; the middle of these withstands one
    bad neighbour.
    """
    lines = [((-1, 0.5), (1, 0.5)), ((-1, 2.0), (-2, -1.0)), ((1, 2.0), (2, -1.0))]
    foretold = [
        sum((share * values[step + n] for n, share in line), np.zeros(3))
        for line in lines
        if all(step + n in values for n, _ in line)
    ]
    return np.asarray(np.abs(values[step] - np.median(foretold, axis=0))) if foretold else np.zeros(3)


def _beyond(seen: FloatArray, known: FloatArray) -> FloatArray:
    """What of a deviation ``(3,)`` sigmas that are known of ``(3,)`` do not explain."""
    return np.asarray(np.sqrt(np.maximum(seen**2 - known**2, 0.0)))


def _unit(vector: FloatArray) -> FloatArray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
