"""Semi-global matching (Hirschmüller 2008) along four directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from erfsfm.refinement.appearance import Array

SMALL_STEP = 0.05  # penalty for a change of one sample between neighbouring pixels
LARGE_STEP = 1.0  # for more, where the image is smooth
EDGE_GREY_LEVELS = 8.0  # image step across which a large step costs 1/e of that


def smoothed(costs: Array, grey: Array) -> Array:
    """Costs ``(C, h, w)`` that also count steps of the solution, which are cheap at edges of the image ``(h, w)``."""
    volume = np.ascontiguousarray(costs.transpose(1, 2, 0))  # (h, w, C)
    by_row = _both_ways(volume, _penalties(grey))
    by_column = _both_ways(volume.transpose(1, 0, 2), _penalties(grey.T)).transpose(1, 0, 2)
    return np.asarray((by_row + by_column).transpose(2, 0, 1))


def _penalties(grey: Array) -> Array:
    """Of a large step between each row and the one before, ``(h - 1, w)``."""
    steps = np.abs(np.diff(grey, axis=0))
    return np.asarray(SMALL_STEP + LARGE_STEP * np.exp(-steps / EDGE_GREY_LEVELS), np.float32)


def _both_ways(volume: NDArray[np.float32], penalties: Array) -> Array:
    """Sum of path costs ``(h, w, C)`` downwards and upwards; both run in one loop."""
    down_up = np.ascontiguousarray(np.stack([volume, volume[::-1]], axis=1))  # (h, 2, w, C)
    large = np.stack([penalties, penalties[::-1]], axis=1)[..., None]  # (h - 1, 2, w, 1)
    padded = np.full((*down_up.shape[1:-1], volume.shape[-1] + 2), np.inf, np.float32)
    for row, step in zip(range(1, len(volume)), large):
        before = down_up[row - 1]
        padded[..., 1:-1] = before
        least = before.min(axis=-1, keepdims=True)
        path = np.minimum(padded[..., :-2], padded[..., 2:])
        path += np.float32(SMALL_STEP)
        np.minimum(path, before, out=path)
        path -= least
        np.minimum(path, step, out=path)
        down_up[row] += path
    return np.asarray(down_up[:, 0] + down_up[::-1, 1])
