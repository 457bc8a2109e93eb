"""The unit of a map by learned depth, and its drift along the map."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded

from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe
from slam.geometry.robust import mad_sigma
from slam.geometry.se3 import FloatArray

_LEAST_DEPTHS = 20
_SHARED = 10  # keyframes that share an error of learned depth
_SIGMA, _LEAST_SIGMA = 0.3, 0.05  # of the logarithm of the unit of an image's learned depth, where it is not measured


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
    if not np.isfinite(own).any():
        return np.ones(len(own)), np.ones(len(own))
    weight = np.where(np.isfinite(own), 0.5 / _SHARED / _scatter(own) ** 2, 0.0)
    own = np.nan_to_num(own)
    system = np.zeros((2, len(own)))
    system[1] = weight
    system[0, 1:] = -(carried**-2.0)
    system[1, 1:] += carried**-2.0
    system[1, :-1] += carried**-2.0
    walk = np.asarray(solveh_banded(system[-len(own) :], weight * own))
    return np.exp(walk), np.exp(np.where(weight > 0.0, walk - own, 0.0))


def _logarithm(local: LocalMap, keyframe: TrackedKeyframe) -> float:
    ratios = local.ratios(keyframe)
    known = ratios[ratios > 0.0]
    return -float(np.median(np.log(known))) if len(known) >= _LEAST_DEPTHS else np.nan


def _scatter(logarithms: FloatArray) -> float:
    """Of the units of learned depth about that of the map, by keyframes that share no error."""
    apart = logarithms[_SHARED:] - logarithms[:-_SHARED]
    apart = apart[np.isfinite(apart)]
    if len(apart) < _SHARED:
        return _SIGMA
    return float(np.clip(mad_sigma(apart) / np.sqrt(2.0), _LEAST_SIGMA, _SIGMA))
