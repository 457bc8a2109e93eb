"""Where the pixels of one image lie in a neighbour, as functions of their inverse depth."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.mvs.appearance import Array

LEAST_Z = 1e-3


class Projection:
    """``K (R p + d t)`` for all pixels p of an image, with the rotated rays computed once."""

    def __init__(
        self, K: NDArray[np.floating], T_neighbour_target: NDArray[np.floating], height: int, width: int
    ) -> None:
        H = (K @ T_neighbour_target[:3, :3] @ np.linalg.inv(K)).astype(np.float32)
        u, v = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
        self._rotated = [H[row, 0] * u + H[row, 1] * v + H[row, 2] for row in range(3)]  # (H, W) each
        self._moved = (K @ T_neighbour_target[:3, 3]).astype(np.float32)

    def pixels(self, inverse_depth: Array) -> tuple[Array, Array, Array]:
        """Columns, rows and z over the depth, ``(H, W)`` each."""
        x, y, z = (cv2.scaleAdd(inverse_depth, float(m), r) for r, m in zip(self._rotated, self._moved, strict=True))
        z = cv2.max(z, LEAST_Z)
        return x / z, y / z, z

    def motion(self, u: Array, v: Array, z: Array, inverse_depth: Array) -> tuple[Array, Array]:
        """Derivatives of columns and rows with respect to the logarithm of the inverse depth."""
        k = inverse_depth / z
        moved = self._moved
        return (moved[0] - u * moved[2]) * k, (moved[1] - v * moved[2]) * k


def halved(K: NDArray[np.floating]) -> NDArray[np.float64]:
    """The camera matrix of an image of half the size; pixel centres are at integers."""
    half = np.array(K, dtype=np.float64)
    half[:2] *= 0.5
    half[:2, 2] -= 0.25
    return half
