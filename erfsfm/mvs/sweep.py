"""Plane sweep around a learned depth (Collins 1996, Gallup et al. 2007): the cost of each change of the depth."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.mvs.appearance import Array
from erfsfm.mvs.projection import Projection
from erfsfm.mvs.semi_global import LARGEST_COST, UNIT, Costs

# changes of the logarithm of inverse depth, denser near the guess; negative is farther
CHANGES: Array = np.array([-2.4, -1.6, -1.0, -0.7, *(np.arange(-5, 7) / 10), 0.8, 1.0, 1.25], dtype=np.float32)
LARGEST_DIFFERENCE = 0.8  # of normalised grey levels: more is an occlusion
WINDOW_PX = 5
WEIGHT_UNSEEN = 0.5  # of the cost of the guess, in views
COST_OF_CHANGE = 0.1  # a unit of log inverse depth
_OUTSIDE = 1e3


def sweep(levels: Array, neighbours: Sequence[tuple[Array, Projection]], inverse_depth: Array) -> Costs:
    """Cost ``(C, h, w)`` of each change of the inverse depth.

    Args:
        levels: normalised target ``(h, w)``.
        neighbours: normalised images ``(h, w)``, each with the projection into it.
        inverse_depth: the guess ``(h, w)``.
    """
    costs = np.empty((len(CHANGES), *levels.shape), np.int16)
    total, seen = _differences(levels, neighbours, inverse_depth)
    # a change out of sight is neither better nor worse than the guess; the fewer see a pixel, the more that counts
    unseen = total * np.float32(WEIGHT_UNSEEN) / np.maximum(seen, np.float32(1e-3))
    for cost, change in zip(costs, CHANGES):
        total, seen = _differences(levels, neighbours, inverse_depth * np.exp(change))
        total += unseen
        total += COST_OF_CHANGE * len(neighbours) * abs(change)
        total /= seen + np.float32(WEIGHT_UNSEEN)
        cost[:] = np.minimum(total, np.float32(LARGEST_COST)) * np.float32(UNIT)
    return costs


def _differences(
    levels: Array, neighbours: Sequence[tuple[Array, Projection]], inverse_depth: Array
) -> tuple[Array, Array]:
    """Sums ``(h, w)`` over neighbours of truncated differences, and of how many see a pixel; means over the window."""
    total, unseen = np.zeros_like(levels), np.zeros(levels.shape, np.uint8)
    for other, projection in neighbours:
        u, v, _ = projection.pixels(inverse_depth)
        difference = cv2.absdiff(warped(other, u, v), levels)
        unseen += ~is_inside(difference)
        total += cv2.min(difference, LARGEST_DIFFERENCE)
    window = (WINDOW_PX, WINDOW_PX)
    missing = cv2.boxFilter(unseen, cv2.CV_32F, window)
    return cv2.boxFilter(total, -1, window) - np.float32(LARGEST_DIFFERENCE) * missing, len(neighbours) - missing


def warped(image: Array, u: Array, v: Array) -> Array:
    """An image at other pixels; very large outside of it."""
    outside = (_OUTSIDE,) * 4
    return np.asarray(
        cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=outside), np.float32
    )


def is_inside(levels: Array) -> NDArray[np.bool_]:
    """Which of the levels that ``warped`` gave lie inside of the image."""
    return np.asarray(np.abs(levels) < _OUTSIDE / 100)


def lowest(costs: Costs) -> Array:
    """The change ``(h, w)`` of least cost, between samples by a parabola."""
    best = costs.argmin(axis=0)
    middle = np.clip(best, 1, len(costs) - 2)
    around = (np.take_along_axis(costs, (middle + k)[None], axis=0)[0] for k in (-1, 0, 1))
    before, at, after = (cost.astype(np.float32) for cost in around)
    shift = np.clip((before - after) / (2 * np.maximum(before + after - 2 * at, 1)), -0.5, 0.5)
    position = np.where(best == middle, middle + shift, best)
    return np.asarray(np.interp(position, np.arange(len(costs)), CHANGES), np.float32)
