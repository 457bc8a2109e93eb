"""Images made comparable: grey levels free of local brightness and contrast."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
Array = NDArray[np.float32]

NEIGHBOURHOOD_PX = 3.0  # standard deviation of the Gaussian window
CONTRAST_FLOOR = 4.0  # grey levels: what is less is noise


@dataclass(frozen=True)
class Appearance:
    """A grey image ``(H, W)`` and at half size ``(h, w)``: grey levels, plain and normalised.

    ``slopes`` are the derivatives of ``levels`` along x and y.
    """

    grey: Array
    levels: Array
    slopes: tuple[Array, Array]
    coarse: Array
    coarse_grey: Array

    @classmethod
    def of(cls, grey: Grey) -> Appearance:
        """Normalise a grey image ``(H, W)``."""
        height, width = grey.shape
        half = cv2.resize(grey, (max(width // 2, 1), max(height // 2, 1)), interpolation=cv2.INTER_AREA)
        full, small = grey.astype(np.float32), np.asarray(half, np.float32)
        levels = normalised(full)
        along_x = cv2.Sobel(levels, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
        along_y = cv2.Sobel(levels, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
        return cls(full, levels, (np.asarray(along_x), np.asarray(along_y)), normalised(small), small)


def normalised(grey: Array) -> Array:
    """Grey levels ``(H, W)`` minus their local mean, over their local standard deviation."""
    mean = cv2.GaussianBlur(grey, (0, 0), NEIGHBOURHOOD_PX)
    variance = cv2.GaussianBlur(grey * grey, (0, 0), NEIGHBOURHOOD_PX) - mean * mean
    return np.asarray((grey - mean) / (np.sqrt(np.maximum(variance, 0)) + np.float32(CONTRAST_FLOOR)), np.float32)
