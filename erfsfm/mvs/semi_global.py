"""Semi-global matching (Hirschmüller 2008) along four directions, in integers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from erfsfm.mvs.appearance import Array

Costs = NDArray[np.int16]

UNIT = 2048  # of costs: the sum over four paths stays below the largest integer
LARGEST_COST = 2.9
SMALL_STEP = 0.05  # penalty for a change of one sample between neighbouring pixels
LARGE_STEP = 1.0  # for more, where the image is smooth
EDGE_GREY_LEVELS = 8.0  # image step across which a large step costs 1/e of that


def smoothed(costs: Costs, grey: Array) -> Costs:
    """Costs ``(C, h, w)`` that also count steps of the solution, which are cheap at edges of the image ``(h, w)``.

    They are known up to a constant of each pixel.
    """
    by_row = _both_ways(costs.transpose(1, 0, 2), _penalties(grey))  # (h, C, w)
    by_column = _both_ways(costs.transpose(2, 0, 1), _penalties(grey.T))  # (w, C, h)
    return np.asarray(by_row.transpose(1, 0, 2) + by_column.transpose(1, 2, 0))


def _penalties(grey: Array) -> Costs:
    """Of a large step between each row and the one before, ``(h - 1, w)``."""
    steps = np.abs(np.diff(grey, axis=0))
    return np.asarray(UNIT * (SMALL_STEP + LARGE_STEP * np.exp(-steps / EDGE_GREY_LEVELS)), np.int16)


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
    return np.asarray(down_up[..., :width] + down_up[::-1, :, width:])
