"""A plane sweep (Collins 1996, Gallup et al. 2007) around a guess of the depth.

Its costs are smoothed by semi-global matching (Hirschmüller 2008) along four directions, in integers.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.mvs.views import Array, Projection

WINDOW_PX = 7
# changes of the logarithm of inverse depth, denser near the guess; negative is farther. Learned depth is
# hardly ever wrong by more
CHANGES: Array = np.array([-1.0, -0.7, *(np.arange(-5, 7) / 10), 0.8, 1.0], dtype=np.float32)
LARGEST_DIFFERENCE = 1.6  # of normalised grey levels: more is an occlusion
WEIGHT_UNSEEN = 0.5  # of the cost of the guess, in views
COST_OF_CHANGE = 0.1  # a unit of log inverse depth
_OUTSIDE = 1e3
Costs = NDArray[np.int16]
UNIT = 2048  # of costs: the sum over four paths stays below the largest integer
LARGEST_COST = 2.9
SMALL_STEP = 0.05  # penalty for a change of one sample between neighbouring pixels
LARGE_STEP = 1.0  # for more, where the image is smooth
EDGE_GREY_LEVELS = 8.0  # image step across which a large step costs 1/e of that


def sweep(
    levels: Array, neighbours: Sequence[tuple[Array, Projection]], inverse_depth: Array
) -> Costs:
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
    return cv2.boxFilter(total, -1, window) - np.float32(LARGEST_DIFFERENCE) * missing, len(
        neighbours
    ) - missing


def warped(image: Array, u: Array, v: Array) -> Array:
    """An image at other pixels; very large outside of it."""
    outside = (_OUTSIDE,) * 4
    return cv2.remap(
        image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=outside
    )


def is_inside(levels: Array) -> NDArray[np.bool_]:
    """Which of the levels that ``warped`` gave lie inside of the image."""
    return np.abs(levels) < _OUTSIDE / 100


def lowest(costs: Costs) -> Array:
    """The change ``(h, w)`` of least cost, between samples by a parabola."""
    best = costs.argmin(axis=0)
    middle = np.clip(best, 1, len(costs) - 2)
    around = middle + np.array([-1, 0, 1])[:, None, None]
    before, at, after = np.take_along_axis(costs, around, axis=0).astype(np.float32)
    shift = np.clip((before - after) / (2 * np.maximum(before + after - 2 * at, 1)), -0.5, 0.5)
    position = np.where(best == middle, middle + shift, best)
    return np.asarray(np.interp(position, np.arange(len(costs)), CHANGES), np.float32)


def smoothed(costs: Costs, grey: Array) -> Costs:
    """Costs ``(C, h, w)`` that also count steps of the solution, which are cheap at edges of the image ``(h, w)``.

    They are known up to a constant of each pixel.
    """
    by_row = _both_ways(costs.transpose(1, 0, 2), _penalties(grey))  # (h, C, w)
    by_column = _both_ways(costs.transpose(2, 0, 1), _penalties(grey.T))  # (w, C, h)
    return by_row.transpose(1, 0, 2) + by_column.transpose(1, 2, 0)


def _penalties(grey: Array) -> Costs:
    """Of a large step between each row and the one before, ``(h - 1, w)``."""
    steps = np.abs(np.diff(grey, axis=0))
    return np.asarray(
        UNIT * (SMALL_STEP + LARGE_STEP * np.exp(-steps / EDGE_GREY_LEVELS)), np.int16
    )


def _both_ways(volume: Costs, penalties: Costs) -> Costs:
    """Sum of path costs ``(h, C, w)`` downwards and upwards; both run in one loop."""
    height, samples, width = volume.shape
    padded = np.full((height, samples + 2, 2 * width), 4 * UNIT, np.int16)
    down_up = padded[:, 1:-1]
    down_up[..., :width], down_up[..., width:] = volume, volume[::-1]
    down_up[0] -= down_up[0].min(axis=0)
    path, small = np.empty_like(down_up[0]), np.int16(UNIT * SMALL_STEP)
    for before, row, large in zip(padded, down_up[1:], np.hstack([penalties, penalties[::-1]])):
        np.minimum(before[:-2], before[2:], out=path)
        path += small
        np.minimum(path, before[1:-1], out=path)
        np.minimum(path, large, out=path)
        row += path
        row -= row.min(axis=0)
    return down_up[..., :width] + down_up[::-1, :, width:]
