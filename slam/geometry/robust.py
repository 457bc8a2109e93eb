"""Robust statistics: scale by the median absolute deviation, and medians with weights."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray

MAD_TO_SIGMA = 1.4826
"""Standard deviation of normal errors over their median absolute deviation."""


def mad_sigma(residuals: NDArray[np.floating[Any]]) -> float:
    """Sigma of residuals about zero, any shape, by their median absolute value; NaN where there are none."""
    return MAD_TO_SIGMA * float(np.median(np.abs(residuals)))


def mad_sigmas(residuals: FloatArray) -> FloatArray:
    """The same of each column of residuals ``(N, K)``, ``(K,)``."""
    return np.asarray(MAD_TO_SIGMA * np.median(np.abs(residuals), axis=0))


def weighted_median(values: FloatArray, weights: FloatArray) -> float:
    """The value ``(N,)`` at which half of the weight ``(N,)`` is reached."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(cumulative, cumulative[-1] / 2)])
