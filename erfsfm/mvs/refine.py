"""Learned depth as a prior, neighbouring images at known poses as the measurement.

A plane sweep around the prior finds each pixel's change of depth, which a Gauss-Newton step on all neighbours at once
sharpens.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.mvs.plane_sweep import WINDOW_PX, Costs, is_inside, lowest, smoothed, sweep, warped
from erfsfm.mvs.views import Appearance, Array, Projection

RESIDUAL = 0.5  # of normalised grey levels, beyond which a pixel loses weight
RESIDUAL_FLOOR = 0.02  # least variance of the residuals
SWEEP_SIGMA = 0.06  # of log inverse depth, before the Gauss-Newton step
LARGEST_STEP = 0.08
INDEPENDENT_PIXELS = 3.0  # of a window: residuals of neighbouring pixels are correlated
SIGMA_FLOOR = 0.03
LEAST_FIT = 0.45  # mean weight of neighbours below which no depth explains them: the guess stays
LEAST_PRIOR_SIGMA = 0.15


@dataclass(frozen=True)
class RefinedDepth:
    """Z-depth ``(H, W)``, its sigma relative to it, and which pixels were measured."""

    depth: Array
    relative_sigma: Array
    measured: NDArray[np.bool_]


@dataclass(frozen=True)
class Measurement:
    """What the neighbours of an image say about its depth.

    Of the ``target``, its learned z-depth ``(H, W)`` and its camera matrix ``(3, 3)``: the ``change`` of log inverse
    depth ``(H, W)``, the ``information`` on it, and the ``fit``, the neighbours' mean weight; ``costs`` of the plane
    sweep ``(C, H, W)``, and the ``coarse`` change ``(H, W)`` by smoothed ones.
    """

    target: Appearance
    depth: Array
    K: NDArray[np.floating]
    change: Array
    information: Array
    fit: Array
    costs: Costs
    coarse: Array

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Pixels ``(H, W)`` that the images decide."""
        return (self.information > 1 / LEAST_PRIOR_SIGMA**2) & (self.fit >= LEAST_FIT)


Decide = Callable[[Measurement], RefinedDepth]


def measure(
    target: Appearance,
    depth: Array,
    neighbours: Sequence[Appearance],
    K: NDArray[np.floating],
    T_neighbour_target: NDArray[np.float64],
) -> Measurement:
    """Compare an image with its neighbours around its learned depth.

    Args:
        target: the image, ``(H, W)``.
        depth: its learned z-depth ``(H, W)``, positive.
        neighbours: N images of the same camera.
        K: camera matrix ``(3, 3)`` of these images.
        T_neighbour_target: ``(N, 4, 4)``; the unit of its translations is that of the depth.
    """
    inverse = (1 / depth).astype(np.float32)
    where = [Projection(K, T, *depth.shape) for T in T_neighbour_target]
    views = list(zip(neighbours, where))
    costs = sweep(target.levels, [(other.levels, at) for other, at in views], inverse)
    coarse = lowest(smoothed(costs, target.grey))
    change = np.asarray(cv2.medianBlur(coarse, 5), np.float32)
    step, information, fit = _gauss_newton(target.levels, views, inverse * np.exp(change))
    return Measurement(target, depth, K, change + step, information, fit, costs, coarse)


def _gauss_newton(
    levels: Array, views: Sequence[tuple[Appearance, Projection]], inverse_depth: Array
) -> tuple[Array, Array, Array]:
    """The next change of log inverse depth ``(H, W)``, the images' information about it, and their mean weight."""
    squares, products, errors, weights, seen = (np.zeros_like(levels) for _ in range(5))
    for other, projection in views:
        u, v, z = projection.pixels(inverse_depth)
        residual = warped(other.levels, u, v) - levels
        inside = is_inside(residual)
        residual *= inside
        weight = inside / np.square(1 + np.square(residual * np.float32(1 / RESIDUAL)))
        du, dv = projection.motion(u, v, z, inverse_depth)
        slope = warped(other.slopes[0], u, v) * du + warped(other.slopes[1], u, v) * dv
        weighted = weight * slope
        squares += weighted * slope
        products += weighted * residual
        errors += weight * residual * residual
        weights += weight
        seen += inside
    window = (WINDOW_PX, WINDOW_PX)
    squares, products, errors, weights, seen = (
        cv2.boxFilter(part, -1, window) for part in (squares, products, errors, weights, seen)
    )
    variance = errors / np.maximum(weights, 1e-3) + RESIDUAL_FLOOR
    damping = variance / (INDEPENDENT_PIXELS * SWEEP_SIGMA**2)
    step = np.clip(-products / (squares + damping), -LARGEST_STEP, LARGEST_STEP)
    information = INDEPENDENT_PIXELS * squares / variance * np.square(weights / len(views))
    return step, information, weights / np.maximum(seen, 1e-3)
