"""The unit of a map of keyframes by learned depth, of the whole map and with its drift along it."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded

from slam.frontend.keyframes.local_map import LocalMap
from slam.geometry.robust import mad_sigma
from slam.geometry.se3 import FloatArray

_LEAST_DEPTHS = 20
_SHARED = 10  # keyframes that share an error of learned depth
# of the logarithm of the unit of an image's learned depth, where it is not measured
_SIGMA = 0.3
_LEAST_SIGMA = 0.05


def learned_unit(local: LocalMap) -> float:
    """Learned depth over depth in the map, the median over all sightings by keyframes; 1 where there are few."""
    joined = np.concatenate([local.ratios(keyframe) for keyframe in local.keyframes])
    known = joined[joined > 0.0]
    return float(np.median(1.0 / known)) if len(known) >= _LEAST_DEPTHS else 1.0


def learned_units(local: LocalMap, carried: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Learned depth over depth in the map along it ``(K,)``, and over what each keyframe says of it ``(K,)``.

    The logarithm of the unit is a random walk with sigmas ``carried`` ``(K - 1,)`` from each
    keyframe to the next.
    """
    own = np.full(len(local.keyframes), np.nan)
    for row, keyframe in enumerate(local.keyframes):
        ratios = local.ratios(keyframe)
        known = ratios[ratios > 0.0]
        if len(known) >= _LEAST_DEPTHS:
            own[row] = -float(np.median(np.log(known)))
    if not np.isfinite(own).any():
        return np.ones(len(own)), np.ones(len(own))
    # the scatter of the units of learned depth about that of the map, by keyframes that share no
    # error
    apart = own[_SHARED:] - own[:-_SHARED]
    apart = apart[np.isfinite(apart)]
    usual = _SIGMA
    if len(apart) >= _SHARED:
        usual = float(np.clip(mad_sigma(apart) / np.sqrt(2.0), _LEAST_SIGMA, _SIGMA))
    weight = np.where(np.isfinite(own), 0.5 / _SHARED / usual**2, 0.0)
    own = np.nan_to_num(own)
    system = np.zeros((2, len(own)))
    system[1] = weight
    system[0, 1:] = -(carried**-2.0)
    system[1, 1:] += carried**-2.0
    system[1, :-1] += carried**-2.0
    walk = np.asarray(solveh_banded(system[-len(own) :], weight * own))
    return np.exp(walk), np.exp(np.where(weight > 0.0, walk - own, 0.0))
