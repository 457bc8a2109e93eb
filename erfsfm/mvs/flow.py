"""Depth of one image from its neighbours at known poses, by optical flow and epipolar geometry.

Dense inverse search flow (Kroeger et al. 2016) to each neighbour, checked forwards and backwards, gives the inverse
depth whose projection lies nearest to the flow's end point; the neighbours' answers are averaged where they agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
Array = NDArray[np.float32]

FLOW_NOISE_PX = 0.3
ROUND_TRIP_PX = 0.5
OFF_LINE_PX = 1.0
OUTLIER_SIGMAS = 3.0  # from the median of the neighbours
LEAST_VIEWS = 2


@dataclass(frozen=True)
class MeasuredDepth:
    """Inverse depth ``(H, W)`` in one over the unit of the poses, and its sigma, infinite where unknown."""

    inverse_depth: Array
    sigma: Array


def measure(
    target: Grey,
    neighbours: Sequence[Grey],
    K: NDArray[np.floating],
    T_neighbour_target: NDArray[np.float64],
    fine: bool = False,
) -> MeasuredDepth:
    """Inverse depth of the target's pixels where at least two neighbours agree.

    Args:
        target: grey image ``(H, W)``.
        neighbours: N images of the same camera.
        K: camera matrix ``(3, 3)`` of these images.
        T_neighbour_target: ``(N, 4, 4)``; the unit of its translations is that of the depth.
        fine: flow down to single pixels, four times as slow.
    """
    values, sigmas = [], []
    for image, T in zip(neighbours, T_neighbour_target):
        flow, trusted = optical_flow(target, image, fine)
        d, sigma, off_line_px = triangulate(flow, T, K)
        sigma[~trusted | (off_line_px > OFF_LINE_PX)] = np.inf
        values.append(d)
        sigmas.append(sigma)
    return combine(np.stack(values), np.stack(sigmas))


def combine(values: Array, sigmas: Array) -> MeasuredDepth:
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
    return MeasuredDepth(mean.astype(np.float32), sigma.astype(np.float32))


def rays(height: int, width: int, K: NDArray[np.floating]) -> Array:
    """``K^-1 (u, v, 1)`` of every pixel, ``(H, W, 3)``."""
    v, u = np.mgrid[:height, :width].astype(np.float32)
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1).astype(np.float32)


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
        back, u + there[..., 0], v + there[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1e3
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
