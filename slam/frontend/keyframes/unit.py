"""The unit of a map by learned depth, and its drift along the map."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded

from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe
from slam.geometry.se3 import FloatArray

_LEAST_DEPTHS = 20
_LEARNED = 0.3 * np.sqrt(2 * 10)  # sigma of the logarithm of learned depth's unit, one error for some ten keyframes


def learned_unit(local: LocalMap) -> float:
    """Learned depth over depth in the map, the median over all sightings by keyframes; 1 where there are few."""
    joined = np.concatenate([local.ratios(keyframe) for keyframe in local.keyframes])
    known = joined[joined > 0.0]
    return float(np.median(1.0 / known)) if len(known) >= _LEAST_DEPTHS else 1.0


def learned_units(local: LocalMap, carried: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Learned depth over depth in the map along it ``(K,)``, and over what each keyframe says of it ``(K,)``.

    Args:
        local: the map.
        carried: sigmas of the logarithm of the unit from each keyframe to the next ``(K - 1,)``, a random walk.
    """
    own = np.array([_logarithm(local, keyframe) for keyframe in local.keyframes])
    weight = np.where(np.isfinite(own), _LEARNED**-2.0, 0.0)
    if not weight.any():
        return np.ones(len(own)), np.ones(len(own))
    own = np.nan_to_num(own)
    system = np.zeros((2, len(own)))
    system[1] = weight
    system[0, 1:] = -(carried**-2.0)
    system[1, 1:] += carried**-2.0
    system[1, :-1] += carried**-2.0
    walk = np.asarray(solveh_banded(system, weight * own))
    return np.exp(walk), np.exp(np.where(weight > 0.0, walk - own, 0.0))


def _logarithm(local: LocalMap, keyframe: TrackedKeyframe) -> float:
    ratios = local.ratios(keyframe)
    known = ratios[ratios > 0.0]
    return -float(np.median(np.log(known))) if len(known) >= _LEAST_DEPTHS else np.nan
