"""Motion up to scale and depth in units of that motion, from two images of a moving camera.

Dense inverse search flow (Kroeger et al. 2016), the five-point essential matrix on it (Nister 2004), and the
least-squares point on each epipolar line.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
Array = NDArray[np.float32]

FLOW_NOISE_PX = 0.3
ROUND_TRIP_PX = 0.5
EPIPOLAR_PX = 0.4
OFF_LINE_PX = 1.0
STILL_PX = 0.3
GRID_PX = 6
LEAST_MATCHES = 50


@dataclass(frozen=True)
class MotionAndDepth:
    """The second view of a pair, measured from the first.

    Attributes:
        T_second_first: ``(4, 4)``, translation of length one; the identity of a camera that stood still.
        inverse_depth: of the first camera's pixels in units of one over the translation, ``(H, W)``.
        sigma: its standard deviation; infinite where unknown.
    """

    T_second_first: NDArray[np.float64]
    inverse_depth: Array
    sigma: Array

    @property
    def still(self) -> bool:
        """Whether the camera stood still."""
        return not self.T_second_first[:3, 3].any()


def two_view(first: Grey, second: Grey, K: NDArray[np.float32], fine: bool) -> MotionAndDepth | None:
    """Motion and structure from two grey images ``(H, W)`` of one camera; None where they show no clear motion.

    Args:
        fine: flow down to single pixels, four times as slow.
    """
    flow, trusted = _flow(first, second, fine)
    matrix = K.astype(np.float64)
    T_second_first = _motion(flow, trusted, matrix)
    if T_second_first is None:
        return None
    if not T_second_first[:3, 3].any():
        return MotionAndDepth(T_second_first, np.zeros_like(flow[..., 0]), np.full_like(flow[..., 0], np.inf))
    inverse_depth, sigma, off_line_px = _triangulate(flow, T_second_first, K)
    sigma[~trusted | (off_line_px > OFF_LINE_PX)] = np.inf
    return MotionAndDepth(T_second_first, inverse_depth, sigma)


def rays(height: int, width: int, K: NDArray[np.float32]) -> Array:
    """``K^-1 (u, v, 1)`` of every pixel, ``(H, W, 3)``."""
    v, u = np.mgrid[:height, :width].astype(np.float32)
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)


def _flow(first: Grey, second: Grey, fine: bool) -> tuple[Array, NDArray[np.bool_]]:
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


def _motion(flow: Array, trusted: NDArray[np.bool_], K: NDArray[np.float64]) -> NDArray[np.float64] | None:
    chosen = np.zeros_like(trusted)
    chosen[GRID_PX // 2 :: GRID_PX, GRID_PX // 2 :: GRID_PX] = True
    v, u = np.nonzero(chosen & trusted)
    if len(u) < LEAST_MATCHES:
        return None
    a = np.stack([u, v], axis=1).astype(np.float64)
    moved = flow[v, u]
    if np.median(np.linalg.norm(moved, axis=1)) < STILL_PX:
        return np.eye(4)
    cv2.setRNGSeed(0)
    E, mask = cv2.findEssentialMat(a, a + moved, K, method=cv2.USAC_MAGSAC, prob=0.999, threshold=EPIPOLAR_PX)
    if E is None or E.shape != (3, 3):
        return None
    inliers, R, t, _ = cv2.recoverPose(E, a, a + moved, K, mask=mask)
    if inliers < LEAST_MATCHES:
        return None
    T_second_first = np.eye(4)
    T_second_first[:3, :3], T_second_first[:3, 3] = R, t.ravel()
    return T_second_first


def _triangulate(
    flow: Array, T_second_first: NDArray[np.float64], K: NDArray[np.float32]
) -> tuple[Array, Array, Array]:
    """Inverse depth d with ``pi(R p + d t)`` nearest to the flow's end point, its sigma, and the residual in pixels."""
    R, t = T_second_first[:3, :3].astype(np.float32), T_second_first[:3, 3].astype(np.float32)
    p = rays(flow.shape[0], flow.shape[1], K)
    q = p @ R.T
    x, y = p[..., 0] + flow[..., 0] / K[0, 0], p[..., 1] + flow[..., 1] / K[1, 1]
    a_x, b_x = t[0] - x * t[2], x * q[..., 2] - q[..., 0]
    a_y, b_y = t[1] - y * t[2], y * q[..., 2] - q[..., 1]
    parallax = a_x**2 + a_y**2 + np.float32(1e-12)
    d = (a_x * b_x + a_y * b_y) / parallax
    off_line_px = np.hypot(d * a_x - b_x, d * a_y - b_y) * K[0, 0]
    return d, FLOW_NOISE_PX / (np.sqrt(parallax) * K[0, 0]), off_line_px
