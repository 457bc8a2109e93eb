"""Descriptors of 256 bits: SIFT of corners that are tracked, and the distance of any two.

Corners that are tracked have SIFT (Lowe 2004) as 256 bits, so that words, matching and files are
those of ORB: two thresholds code a value, and Hamming's distance is the distance between the sums
of coded differences.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import Descriptors, Grey
from slam.geometry.se3 import FloatArray

_SIFT_SIZE_PX = 8.0
# terciles of square roots of SIFT's normed values (Arandjelovic and Zisserman 2012) over the
# corners of a kitchen
_LOW = 0.034
_HIGH = 0.082
_RADIUS_PX = 15  # around a corner, for its direction
_BLUR_PX = 2.0


def describe(grey: Grey, pixels: NDArray[np.floating[Any]]) -> Descriptors:
    """Descriptors ``(M, 32)`` of corners ``(M, 2)``, each turned into its own direction."""
    if not len(pixels):
        return np.zeros((0, 32), np.uint8)
    # at half the size a quarter of the pixels describe the same surroundings
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    corners = []
    for (u, v), angle in zip(pixels, _directions_deg(grey, pixels), strict=True):
        x, y = 0.5 * float(u) - 0.25, 0.5 * float(v) - 0.25
        corners.append(cv2.KeyPoint(x, y, _SIFT_SIZE_PX / 2, float(angle), 1.0, 0, 0))
    _, values = cv2.SIFT.create().compute(half, corners)
    roots = np.sqrt(values / np.maximum(values.sum(axis=1, keepdims=True), 1e-9))
    return np.packbits(np.concatenate([roots > _LOW, roots > _HIGH], axis=1), axis=1)


def hamming(first: Descriptors, second: Descriptors) -> NDArray[np.float32]:
    """Differing bits ``(M, N)`` of every pair of descriptors ``(M, 32)`` and ``(N, 32)``."""
    words_first = np.ascontiguousarray(first).view(np.uint64).T  # (4, M)
    words_second = np.ascontiguousarray(second).view(np.uint64).T  # (4, N)
    differing = np.zeros((len(first), len(second)), np.uint16)
    for a, b in zip(words_first, words_second, strict=True):
        differing += np.bitwise_count(a[:, None] ^ b)
    return differing.astype(np.float32)


def _directions_deg(grey: Grey, pixels: NDArray[np.floating[Any]]) -> FloatArray:
    """From each corner to the centroid of the grey levels around it (Rosin 1999), degrees in [0, 360)."""
    y, x = np.mgrid[-_RADIUS_PX : _RADIUS_PX + 1, -_RADIUS_PX : _RADIUS_PX + 1]
    inside = x**2 + y**2 <= _RADIUS_PX**2
    x, y = x[inside], y[inside]
    border = _RADIUS_PX + 1
    blurred = cv2.GaussianBlur(grey, (0, 0), _BLUR_PX)
    padded = cv2.copyMakeBorder(blurred, border, border, border, border, cv2.BORDER_REFLECT)
    u, v = np.rint(pixels).astype(np.int64).T + border
    places = np.add.outer(v * padded.shape[1] + u, y * padded.shape[1] + x)
    around = padded.ravel()[places].astype(np.float32)  # whole numbers, of which sums are exact
    down, right = (around @ np.column_stack([y, x]).astype(np.float32)).astype(np.float64).T
    return np.asarray(np.rad2deg(np.arctan2(down, right)) % 360.0)
