"""Labels by flow alone: depth of an image from many neighbours at the poses of the SLAM system.

Lengths are in heights of the camera over the road, the ground plane before the camera. Dense inverse
search flow (Kroeger et al. 2016) to each neighbour, checked forwards and backwards, gives the inverse
depth whose projection lies nearest to the flow's end point; the neighbours' answers are averaged where
they agree.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.mvs.views import Array, Grey

NEIGHBOURS = (-4, -2, -1, 1, 2, 4)  # frames
MIN_SNR = 5.0  # inverse depth over its sigma
LEAST_SIGMA = 0.01  # of the inverse depth: no label is surer, for the poses are not

SKY_BRIGHTNESS = 0.95  # of the brightest pixels of the upper half
SKY_GRADIENT = 8.0  # grey levels a pixel, smoothed
SKY_AHEAD = 0.08  # of the image width, on either side of straight ahead
BELOW_HORIZON = 0.04  # of the image height: a sky that reaches lower is a wall
SKY_INVERSE_DEPTH = 1 / 60  # of a camera height: the sky is farther than 100 m

FLOW_NOISE_PX = 0.3
ROUND_TRIP_PX = 0.5
OFF_LINE_PX = 1.0
OUTLIER_SIGMAS = 3.0  # from the median of the neighbours
LEAST_VIEWS = 2


def label(
    target: Grey,
    neighbours: Sequence[Grey],
    K: NDArray[np.floating],
    T_neighbour_target: NDArray[np.float64],
) -> tuple[Array, Array]:
    """Least and most inverse depth of each pixel ``(H, W)``, in one over camera heights; 0 and infinite if unknown.

    Pixels without two agreeing neighbours are unknown; the sky is bounded from above.

    Args:
        target: grey image ``(H, W)``.
        neighbours: N images of the same camera, earlier ones first.
        K: camera matrix of these images.
        T_neighbour_target: ``(N, 4, 4)``, translations in camera heights.
    """
    inverse_depth, sigma = measure(target, neighbours, K, T_neighbour_target, fine=True)
    sigma = np.maximum(sigma, LEAST_SIGMA * np.abs(inverse_depth))
    known = np.isfinite(sigma)
    least = np.where(known, np.maximum(inverse_depth - sigma, 0), 0)
    most = np.where(known, np.maximum(inverse_depth, 0) + sigma, np.inf)
    sky = sky_mask(target, (float(K[0, 2]), float(K[1, 2])))
    least[sky], most[sky] = 0, SKY_INVERSE_DEPTH
    return least.astype(np.float32), most.astype(np.float32)


def sky_mask(grey: Grey, horizon: tuple[float, float]) -> NDArray[np.bool_]:
    """Bright pixels without texture that are connected to the image's upper edge, ``(H, W)``.

    The sky of a street is seen over its road; a bright wall stands beside it, and reaches down to the ground and hence
    below the horizon.

    Args:
        grey: the image.
        horizon: column and row of the pixel straight ahead.
    """
    height, width = grey.shape
    smooth = cv2.GaussianBlur(grey, (5, 5), 0).astype(np.float32)
    slope = cv2.blur(
        np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)) / 8,
        (3, 3),
    )
    bright = SKY_BRIGHTNESS * np.percentile(smooth[: height // 2], 98)
    plain = (smooth > bright) & (slope < SKY_GRADIENT)
    _, component = cv2.connectedComponents(plain.astype(np.uint8), connectivity=4)
    below = np.unique(component[int(np.clip(horizon[1] + BELOW_HORIZON * height, 0, height)) :])
    ahead = slice(*(int(max(horizon[0] + side * SKY_AHEAD * width, 0)) for side in (-1, 1)))
    over_road = np.intersect1d(component[0], component[:, ahead])
    return np.isin(component, np.setdiff1d(over_road, [0, *below]))


def measure(
    target: Grey,
    neighbours: Sequence[Grey],
    K: NDArray[np.floating],
    T_neighbour_target: NDArray[np.float64],
    fine: bool = False,
) -> tuple[Array, Array]:
    """Inverse depth of the target's pixels where at least two neighbours agree.

    Args:
        target: grey image ``(H, W)``.
        neighbours: N images of the same camera.
        K: camera matrix ``(3, 3)`` of these images.
        T_neighbour_target: ``(N, 4, 4)``; the unit of its translations is that of the depth.
        fine: flow down to single pixels, four times as slow.

    Returns:
        Inverse depth ``(H, W)`` in one over the unit of the poses, and its sigma, infinite where unknown.
    """
    values, sigmas = [], []
    for image, T in zip(neighbours, T_neighbour_target):
        flow, trusted = optical_flow(target, image, fine)
        d, sigma, off_line_px = triangulate(flow, T, K)
        sigma[~trusted | (off_line_px > OFF_LINE_PX)] = np.inf
        values.append(d)
        sigmas.append(sigma)
    return combine(np.stack(values), np.stack(sigmas))


def combine(values: Array, sigmas: Array) -> tuple[Array, Array]:
    """Weighted mean of the neighbours ``(N, H, W)`` that agree with their weighted median."""
    known = np.isfinite(sigmas)
    weights = np.where(known, 1 / np.square(sigmas), 0).astype(np.float32)
    order = np.argsort(np.where(known, values, np.inf), axis=0)
    ranked = np.take_along_axis(weights, order, axis=0).cumsum(axis=0)
    middle = (ranked >= ranked[-1] / 2).argmax(axis=0)
    median = np.take_along_axis(values, np.take_along_axis(order, middle[None], axis=0), axis=0)[0]
    agree = known & (np.abs(values - median) < OUTLIER_SIGMAS * sigmas)
    weights *= agree
    total = weights.sum(axis=0)
    mean = (values * weights).sum(axis=0) / np.maximum(total, 1e-12)
    spread = (weights * np.square(values - mean)).sum(axis=0) / np.maximum(total, 1e-12)
    sigma = np.sqrt(1 / np.maximum(total, 1e-12) + spread)
    sigma[agree.sum(axis=0) < LEAST_VIEWS] = np.inf
    return mean.astype(np.float32), sigma.astype(np.float32)


def rays(height: int, width: int, K: NDArray[np.floating]) -> Array:
    """``K^-1 (u, v, 1)`` of every pixel, ``(H, W, 3)``."""
    v, u = np.mgrid[:height, :width].astype(np.float32)
    return np.stack(
        [(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1
    ).astype(np.float32)


def optical_flow(first: Grey, second: Grey, fine: bool) -> tuple[Array, NDArray[np.bool_]]:
    """Optical flow ``(H, W, 2)`` and the mask of the forward-backward check ``(H, W)``."""
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    if fine:
        search.setFinestScale(0)
        search.setGradientDescentIterations(8)
    there = search.calc(first, second, None)
    back = search.calc(second, first, None)
    v, u = np.mgrid[: first.shape[0], : first.shape[1]].astype(np.float32)
    back_there = cv2.remap(
        back,
        u + there[..., 0],
        v + there[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=1e3,
    )
    return there, np.linalg.norm(there + back_there, axis=-1) < ROUND_TRIP_PX


def triangulate(
    flow: Array, T_second_first: NDArray[np.float64], K: NDArray[np.floating]
) -> tuple[Array, Array, Array]:
    """Inverse depth d with ``pi(R p + d t)`` nearest to the flow's end point, its sigma, and the residual in pixels."""
    R, t = T_second_first[:3, :3].astype(np.float32), T_second_first[:3, 3].astype(np.float32)
    p = rays(flow.shape[0], flow.shape[1], K)
    q = p @ R.T
    fx, fy = np.float32(K[0, 0]), np.float32(K[1, 1])
    x, y = p[..., 0] + flow[..., 0] / fx, p[..., 1] + flow[..., 1] / fy
    a_x, b_x = t[0] - x * t[2], x * q[..., 2] - q[..., 0]
    a_y, b_y = t[1] - y * t[2], y * q[..., 2] - q[..., 1]
    parallax = a_x**2 + a_y**2 + np.float32(1e-12)
    d = (a_x * b_x + a_y * b_y) / parallax
    off_line_px = np.hypot(d * a_x - b_x, d * a_y - b_y) * fx
    return d, FLOW_NOISE_PX / (np.sqrt(parallax) * fx), off_line_px
