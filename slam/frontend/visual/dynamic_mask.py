"""Regions of the image that recently showed dynamic objects.

A car ahead stays at one place of the image for minutes. Some of its corners fit the camera's motion by chance and bias
it, but most do not: where many corners were outliers recently, the others are weighted down
(``docs/design/visual-front-end.md``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray

_CELL_PX = 8.0
_SPREAD_CELLS = 1.5
# decay a step: a half-life of seven steps
_KEPT = 0.9
# weight, in corners, of the prior that a cell has the inlier ratio of the whole image
_PRIOR_CORNERS = 0.5


@dataclass(frozen=True)
class DynamicMask:
    """Inliers and all corners of the last steps by cell of the image ``(h, w)``, decayed exponentially.

    ``sharpness`` is the power of a cell's inlier ratio over that of the whole image; 0 weights all cells equally.
    """

    inliers: FloatArray
    corners: FloatArray
    sharpness: float

    @classmethod
    def empty(cls, width: int, height: int, sharpness: float) -> Self:
        """A mask without observations for images of ``width`` x ``height`` pixels."""
        shape = int(np.ceil(height / _CELL_PX)), int(np.ceil(width / _CELL_PX))
        return cls(np.zeros(shape), np.zeros(shape), sharpness)

    def weights(self, pixels: FloatArray) -> FloatArray:
        """Weights in (0, 1] ``(M,)`` of corners at ``pixels`` ``(M, 2)``."""
        if self.corners.sum() < 1.0:
            return np.ones(len(pixels))
        usual = self.inliers.sum() / self.corners.sum()
        inliers, corners = (cv2.GaussianBlur(kind, (0, 0), _SPREAD_CELLS) for kind in (self.inliers, self.corners))
        ratio = (inliers + _PRIOR_CORNERS * usual) / (corners + _PRIOR_CORNERS)
        return np.asarray(np.minimum(ratio[self._cells(pixels)] / max(usual, 1e-3), 1.0) ** self.sharpness)

    def updated(self, pixels: FloatArray, is_inlier: NDArray[np.bool_]) -> Self:
        """The mask after one more step, whose corners now lie at ``pixels`` ``(M, 2)``."""
        inliers, corners = _KEPT * self.inliers, _KEPT * self.corners
        cells = self._cells(pixels)
        np.add.at(corners, cells, 1.0)
        np.add.at(inliers, cells, is_inlier.astype(float))
        return replace(self, inliers=inliers, corners=corners)

    def _cells(self, pixels: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        column, row = (np.floor(pixels.T / _CELL_PX)).astype(np.int64)
        height, width = self.corners.shape
        return np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
