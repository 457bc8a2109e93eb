"""Robust statistics: scale by the median absolute deviation, medians; least squares of states along a drive."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam.geometry.se3 import FloatArray

MAD_TO_SIGMA = 1.4826
"""Standard deviation of normal errors over their median absolute deviation."""


def median(values: ArrayLike) -> float:
    """The median of known values of any shape, NaN of none; as of NumPy, in a tenth of its time."""
    values = np.asarray(values)
    if not values.size:
        return float("nan")
    below, above = (values.size - 1) // 2, values.size // 2
    ordered = np.partition(values, (below, above), axis=None)
    return float(0.5 * (ordered[below] + ordered[above]))


def rms(errors: FloatArray) -> float:
    """Root mean square of errors of any shape."""
    return float(np.sqrt(np.mean(errors**2)))


def mad_sigma(residuals: NDArray[np.floating[Any]]) -> float:
    """Sigma of residuals about zero, any shape, by their median absolute value; NaN where there are none."""
    return MAD_TO_SIGMA * median(np.abs(residuals))


def weighted_median(values: FloatArray, weights: FloatArray) -> float:
    """The value ``(N,)`` at which half of the weight ``(N,)`` is reached."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(cumulative, cumulative[-1] / 2)])


def running_median(values: FloatArray, window: int) -> FloatArray:
    """Median of the known ones among the ``window`` values ``(N,)`` around each ``(N,)``; NaN where none is known."""
    padded = np.pad(values, window // 2, constant_values=np.nan)
    around = np.sort(np.lib.stride_tricks.sliding_window_view(padded, window))  # NaN is last
    rows, known = np.arange(len(values)), (~np.isnan(around)).sum(axis=1)
    return 0.5 * (around[rows, (known - 1) // 2] + around[rows, known // 2])


def difference_equations(
    plus: NDArray[np.intp],
    minus: NDArray[np.intp],
    value: FloatArray,
    weights: FloatArray,
    idle: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """The normal equations of ``state[plus] - state[minus] = value``, as for `scipy.linalg.solveh_banded`.

    Args:
        plus: places of states ``(M,)``, at most two from those of ``minus``; the place behind the
            last state is zero.
        minus: places ``(M,)``.
        value: of the difference ``(M,)``.
        weights: inverse variances ``(M,)``.
        idle: added to the diagonal ``(N,)``.

    Returns:
        The upper band ``(3, N)`` of the normal matrix, and the right side ``(N,)``.
    """
    band, right = np.zeros((3, len(idle) + 1)), np.zeros(len(idle) + 1)
    band[2, :-1] = idle
    for places, signed in ((plus, weights), (minus, -weights)):
        np.add.at(band[2], places, weights)
        np.add.at(right, places, signed * value)
    # the place behind the last state is far from others, and left out
    apart = np.minimum(np.abs(plus - minus), 2)
    np.subtract.at(band, (2 - apart, np.maximum(plus, minus)), weights)
    return band[:, :-1], right[:-1]
