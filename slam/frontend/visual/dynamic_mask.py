"""Where in the image things lately moved by themselves.

A car ahead stays where it is in the image for minutes. Some of its corners fit the camera's motion by chance, and these
bend it; but most do not, and those beside them are then not to be believed either
(``docs/design/visual-front-end.md``).
"""

from __future__ import annotations

from copy import copy

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.se3 import FloatArray
from slam.storage.serialisation import Learner

_CELL_PX = 8.0
_SPREAD_CELLS = 1.5
# what was seen is half forgotten after seven steps
_KEPT = 0.9
# so many corners' worth of belief that a place is like the rest of the image
_BELIEVED_CORNERS = 0.5


class DynamicMask(Learner):
    """The share of corners that fitted the camera's motion, place by place, over the last steps of one drive."""

    remembers = ("_fitting", "_all")

    def __init__(self, width: int, height: int, sharpness: float) -> None:
        """Nothing seen yet.

        Args:
            width: of the images, pixels.
            height: likewise.
            sharpness: power of a place's share over the usual one; 0 believes all places alike.
        """
        self._sharpness = sharpness
        shape = int(np.ceil(height / _CELL_PX)), int(np.ceil(width / _CELL_PX))
        self._fitting, self._all = np.zeros(shape), np.zeros(shape)

    def weights(self, pixels: FloatArray) -> FloatArray:
        """How far the image is to be believed at ``pixels`` ``(M, 2)``, beside the rest of it: ``(M,)`` in (0, 1]."""
        if self._all.sum() < 1.0:
            return np.ones(len(pixels))
        usual = self._fitting.sum() / self._all.sum()
        fitting, seen = (cv2.GaussianBlur(kind, (0, 0), _SPREAD_CELLS) for kind in (self._fitting, self._all))
        share = (fitting + _BELIEVED_CORNERS * usual) / (seen + _BELIEVED_CORNERS)
        return np.asarray(np.minimum(share[self._cells(pixels)] / max(usual, 1e-3), 1.0) ** self._sharpness)

    def learn(self, pixels: FloatArray, fitting: NDArray[np.bool_]) -> None:
        """Remember which corners, now at ``pixels`` ``(M, 2)``, fitted a step's motion ``(M,)``."""
        self._all, self._fitting = _KEPT * self._all, _KEPT * self._fitting
        cells = self._cells(pixels)
        np.add.at(self._all, cells, 1.0)
        np.add.at(self._fitting, cells, fitting.astype(float))

    def as_now(self) -> DynamicMask:
        """What was seen so far, which nothing learnt later changes."""
        return copy(self)  # learning makes arrays anew

    def _cells(self, pixels: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        column, row = (np.floor(pixels.T / _CELL_PX)).astype(np.int64)
        height, width = self._all.shape
        return np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
