"""The smoothing of a plane sweep's costs."""

from __future__ import annotations

import numpy as np

from erfsfm.mvs.plane_sweep import EDGE_GREY_LEVELS, LARGE_STEP, SMALL_STEP, UNIT, smoothed


def slowly(costs: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """Hirschmüller 2008, Eq. 13, pixel by pixel."""
    samples, height, width = costs.shape
    total = np.zeros(costs.shape)
    for dv, du in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        path = costs.astype(float).copy()
        rows = range(height) if dv >= 0 else range(height - 1, -1, -1)
        for v in rows:
            for u in range(width) if du >= 0 else range(width - 1, -1, -1):
                if not (0 <= v - dv < height and 0 <= u - du < width):
                    continue
                before = path[:, v - dv, u - du]
                step = abs(float(grey[v, u]) - float(grey[v - dv, u - du]))
                large = SMALL_STEP + LARGE_STEP * np.exp(-step / EDGE_GREY_LEVELS)
                for k in range(samples):
                    near = [before[j] for j in (k - 1, k + 1) if 0 <= j < samples]
                    best = min(before[k], min(near) + SMALL_STEP, before.min() + large)
                    path[k, v, u] += best - before.min()
        total += path
    return total


def test_paths_equal_those_of_an_obvious_loop():
    rng = np.random.default_rng(0)
    costs = rng.random((5, 6, 7)).astype(np.float32)
    grey = rng.uniform(0, 40, (6, 7)).astype(np.float32)
    found, expected = smoothed(np.asarray(UNIT * costs, np.int16), grey) / UNIT, slowly(costs, grey)
    np.testing.assert_allclose(
        found - found.min(axis=0), expected - expected.min(axis=0), atol=0.01
    )
