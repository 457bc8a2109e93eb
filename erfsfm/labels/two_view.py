"""Motion up to scale and depth in units of that motion, from two images of a moving camera.

Dense inverse search flow (Kroeger et al. 2016), the five-point essential matrix on it (Nister 2004), and the
least-squares point on each epipolar line.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.mvs.flow import OFF_LINE_PX, Array, Grey, optical_flow, triangulate

EPIPOLAR_PX = 0.4
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
    flow, trusted = optical_flow(first, second, fine)
    matrix = K.astype(np.float64)
    T_second_first = _motion(flow, trusted, matrix)
    if T_second_first is None:
        return None
    if not T_second_first[:3, 3].any():
        return MotionAndDepth(T_second_first, np.zeros_like(flow[..., 0]), np.full_like(flow[..., 0], np.inf))
    inverse_depth, sigma, off_line_px = triangulate(flow, T_second_first, K)
    sigma[~trusted | (off_line_px > OFF_LINE_PX)] = np.inf
    return MotionAndDepth(T_second_first, inverse_depth, sigma)


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
