"""The road in an image of which inverse depth is known.

Its plane, what lies on it, and what only seems to lie under it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.mvs.views import Array

TOLERANCE = 0.05  # of the distance
TRIALS = 100
LEAST_POINTS = 150
LEAST_RATIO = 0.25  # inliers over candidate points
LEAST_UPRIGHT = 0.95  # cosine between the road's normal and the camera's y axis
ROWS = (0.62, 0.9)  # part of the image that a road fills and where its flow can be measured
COLUMNS = (0.3, 0.7)
AROUND = (0.3, 0.1)  # of the image's height and width, in which a pixel's neighbours lie
LEAST_AROUND = 0.1  # fraction of them that is known
LEAST_AGREEING = 0.7  # fraction of the known ones that lies on the road
SIGMAS_UNDER = 2.0  # by which a pixel under the road is significant
RIM_PX = 5  # side of the dilation kernel around such pixels
NEAR = 0.2  # relative depth tolerance of a single pixel of the road, which is noisy


def road_plane(
    inverse_depth: Array, known: NDArray[np.bool_], rays: Array, forward: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """The road as the plane ``m . X = 1``, ``(3,)``, in the unit that the inverse depth is one over.

    The plane contains the direction of travel; it is found by random sampling among the points in the lower middle
    of the image and refined by least squares. The camera is ``1 / |m|`` above it, and a ray p meets it at the inverse
    depth ``m . p``. Without that direction the few rows of a road would hardly constrain its slope, and with it the
    height.

    Args:
        inverse_depth: ``(H, W)``.
        known: where it may be used, ``(H, W)``.
        rays: ``K^-1 (u, v, 1)``, ``(H, W, 3)``.
        forward: direction of travel in the camera's frame, ``(3,)``, of length one.

    Returns:
        None where no plane like a road is found.
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
    flat = (points @ np.stack([across, down], axis=1)).astype(
        np.float64
    )  # (n, 2): along forward a plane is constant
    rng = np.random.default_rng(0)
    first, second = flat[rng.integers(len(flat), size=(2, TRIALS))]
    determinant = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    good = np.abs(determinant) > 1e-9
    lines = (
        np.stack([second[:, 1] - first[:, 1], first[:, 0] - second[:, 0]], axis=1)[good]
        / determinant[good, None]
    )
    lines = lines[lines[:, 1] > LEAST_UPRIGHT * np.linalg.norm(lines, axis=1)]
    if not len(lines):
        return None
    some = flat[rng.integers(len(flat), size=min(len(flat), 600))]
    line = lines[(np.abs(some @ lines.T - 1) < TOLERANCE).sum(axis=0).argmax()]
    for _ in range(3):
        on_plane = flat[np.abs(flat @ line - 1) < TOLERANCE]
        if len(on_plane) < max(LEAST_POINTS, LEAST_RATIO * len(flat)):
            return None
        line = np.linalg.lstsq(on_plane, np.ones(len(on_plane)), rcond=None)[0]
    return line[0] * across + line[1] * down


def on_road(inverse_depth: Array, known: NDArray[np.bool_], road: Array) -> NDArray[np.bool_]:
    """Pixels on the road, ``(H, W)``, as in `impose_road`: nearly all neighbours lie on it that are ``known``."""
    height, width = inverse_depth.shape
    window = (2 * int(AROUND[1] * width / 2) + 1, 2 * int(AROUND[0] * height / 2) + 1)
    agreeing = known & (np.abs(inverse_depth - road) < NEAR * road)
    known_share = _mean_around(known, window)
    agreeing_share = _mean_around(agreeing, window)
    level = (road > 0) & (known_share > LEAST_AROUND)
    level &= agreeing_share > LEAST_AGREEING * known_share
    return level & ~(known & (np.abs(inverse_depth - road) > NEAR * road))


def _mean_around(mask: NDArray[np.bool_], window: tuple[int, int]) -> Array:
    """Share of the window ``(width, height)`` around each pixel that a mask holds, ``(H, W)``."""
    return cv2.blur(mask.astype(np.float32), window, borderType=cv2.BORDER_CONSTANT)


def under_road(inverse_depth: Array, sigma: Array, road: Array) -> NDArray[np.bool_]:
    """Pixels measured clearly below the road, with a rim around them, ``(H, W)``; as in `impose_road`.

    These are dynamic objects that move with the camera, like a car ahead, and only appear far away.
    """
    under = (road > 0) & (inverse_depth + SIGMAS_UNDER * sigma < (1 - NEAR) * road)
    rim = np.ones((RIM_PX, RIM_PX), np.uint8)
    return (cv2.dilate(under.astype(np.uint8), rim) > 0) & (road > 0)


def impose_road(
    inverse_depth: Array, sigma: Array, reliable: NDArray[np.bool_], road: Array
) -> Array:
    """Forget what lies under the road and put the road's own depth where an unknown pixel lies on it, both in place.

    Args:
        inverse_depth: ``(H, W)``.
        sigma: of the inverse depth, ``(H, W)``; infinite afterwards where a pixel is under the road.
        reliable: where the inverse depth may be used, ``(H, W)``.
        road: inverse depth of the road at every pixel, ``(H, W)``, not positive above the horizon.

    Returns:
        Smallest possible inverse depth ``(H, W)``: that of the road, less its tolerance, of pixels under it; else 0.
    """
    at_least = np.zeros_like(inverse_depth)
    under = under_road(inverse_depth, sigma, road)
    sigma[under], at_least[under] = np.inf, (1 - NEAR) * road[under]
    level = on_road(inverse_depth, reliable, road) & ~under & ~reliable
    inverse_depth[level], sigma[level] = road[level], TOLERANCE * road[level]
    return at_least
