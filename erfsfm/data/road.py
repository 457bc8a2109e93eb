"""The road before the camera as a plane: the unit of length that every street offers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

TOLERANCE = 0.05  # of the distance
TRIALS = 100
LEAST_POINTS = 150
LEAST_SHARE = 0.25  # of the points looked at
LEAST_UPRIGHT = 0.95  # cosine between the road's normal and the image's down
ROWS = (0.62, 0.9)  # part of the image that a road fills and where it does not rush by
COLUMNS = (0.3, 0.7)


def camera_height(
    inverse_depth: Array, known: NDArray[np.bool_], rays: Array, forward: NDArray[np.float64]
) -> float | None:
    """Height of the camera over the road, in the unit that the inverse depth is one over.

    A plane ``m . X = 1`` that contains the direction of travel is found by random sampling among the points in the
    lower middle of the image and refined by least squares; ``1 / |m|`` is its distance. Without that direction the
    few rows of a road leave its slope, and with it the height, all too free.

    Args:
        inverse_depth: ``(H, W)``.
        known: where it may be used, ``(H, W)``.
        rays: ``K^-1 (u, v, 1)``, ``(H, W, 3)``.
        forward: direction of travel in the camera's frame, ``(3,)``, of length one.

    Returns:
        None where no plane like a road is seen.
    """
    height, width = inverse_depth.shape
    part = (
        slice(int(ROWS[0] * height), int(ROWS[1] * height)),
        slice(int(COLUMNS[0] * width), int(COLUMNS[1] * width)),
    )
    kept = known[part] & (inverse_depth[part] > 0)
    points = rays[part][kept] / inverse_depth[part][kept][:, None]  # (n, 3)
    if len(points) < LEAST_POINTS:
        return None
    across = np.cross([0.0, 1.0, 0.0], forward)
    across /= np.linalg.norm(across)
    down = np.cross(forward, across)
    flat = (points @ np.stack([across, down], axis=1)).astype(np.float64)  # (n, 2): along forward a plane is constant
    rng = np.random.default_rng(0)
    first, second = flat[rng.integers(len(flat), size=(2, TRIALS))]
    determinant = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    good = np.abs(determinant) > 1e-9
    lines = np.stack([second[:, 1] - first[:, 1], first[:, 0] - second[:, 0]], axis=1)[good] / determinant[good, None]
    lines = lines[lines[:, 1] > LEAST_UPRIGHT * np.linalg.norm(lines, axis=1)]
    if not len(lines):
        return None
    some = flat[rng.integers(len(flat), size=min(len(flat), 600))]
    line = lines[(np.abs(some @ lines.T - 1) < TOLERANCE).sum(axis=0).argmax()]
    for _ in range(3):
        on_plane = flat[np.abs(flat @ line - 1) < TOLERANCE]
        if len(on_plane) < max(LEAST_POINTS, LEAST_SHARE * len(flat)):
            return None
        line = np.linalg.lstsq(on_plane, np.ones(len(on_plane)), rcond=None)[0]
    return float(1 / np.linalg.norm(line))
