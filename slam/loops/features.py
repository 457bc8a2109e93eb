"""Features of frames and their descriptors of 256 bits, whose distance is Hamming's.

Frames of a drive have ORB (Rublee et al. 2011) at corners of its own. Corners that are tracked have
SIFT (Lowe 2004) as 256 bits, so that words, matching and files are those of ORB: two thresholds
code a value, and Hamming's distance is the distance between the sums of coded differences.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import (
    DepthMap,
    Descriptors,
    Frame,
    Grey,
    Intrinsics,
    View,
    nearest_depth,
    resized_mask,
    trusted_depth,
)
from slam.geometry.se3 import FloatArray

_CELL_PX = 32
_DETECTED_PER_KEPT = 4
_EDGE_PX = 16
_CORNER_CONTRAST = 10  # least contrast of a corner, grey levels
_MAX_FEATURES = 500  # largest number of corners kept of a frame
_SIFT_SIZE_PX = 8.0
# terciles of square roots of SIFT's normed values (Arandjelovic and Zisserman 2012) over the
# corners of a kitchen
_LOW = 0.034
_HIGH = 0.082
_RADIUS_PX = 15  # around a corner, for its direction
_BLUR_PX = 2.0


class FeatureExtractor:
    """Extracts features of the frames of one sequence, spread over the image by a grid."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        self._intrinsics = intrinsics
        self._orb = cv2.ORB.create(
            nfeatures=_DETECTED_PER_KEPT * _MAX_FEATURES,
            nlevels=6,
            edgeThreshold=_EDGE_PX,
            fastThreshold=_CORNER_CONTRAST,
        )

    def view(
        self, frame: Frame, depth_unscaled: DepthMap, height_unscaled: float | None = None
    ) -> View:
        """Features of a frame, at the size of its image.

        Args:
            frame: the frame, at the size of the intrinsics.
            depth_unscaled: its learned z-depth ``(H, W)``.
            height_unscaled: camera height in the same unit (see `trusted_depth`).
        """
        pixels, descriptors = self.corners(frame)
        z = trusted_depth(nearest_depth(depth_unscaled, pixels), height_unscaled)
        points = self._intrinsics.rays(pixels) * z[:, None]
        return View(frame.index, pixels, descriptors, points.astype(np.float32))

    def corners(self, frame: Frame) -> tuple[NDArray[np.float32], Descriptors]:
        """Pixels ``(M, 2)`` and descriptors ``(M, 32)`` of what is not fixed to the camera."""
        grey, seen = frame.grey, None
        if frame.fixed is not None:
            seen = (~resized_mask(frame.fixed, *grey.shape[::-1])).view(np.uint8)
        detected = self._orb.detect(grey, seen)
        pixels = np.array([k.pt for k in detected]).reshape(-1, 2)
        response = np.array([k.response for k in detected])
        column, row = (pixels // _CELL_PX).astype(int).T
        cell = row * (grey.shape[1] // _CELL_PX + 1) + column
        # the best of every cell first, then the second best, and so on
        by_cell = np.lexsort((-response, cell))
        rank = np.arange(len(by_cell)) - np.searchsorted(cell[by_cell], cell[by_cell])
        strongest = by_cell[np.lexsort((-response[by_cell], rank))][:_MAX_FEATURES]
        chosen, descriptors = self._orb.compute(grey, [detected[k] for k in strongest])
        if not chosen:
            return np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8)
        return np.array([keypoint.pt for keypoint in chosen], np.float32), descriptors


def describe(grey: Grey, pixels: NDArray[np.floating[Any]]) -> Descriptors:
    """Descriptors ``(M, 32)`` of corners ``(M, 2)``, each turned into its own direction."""
    if not len(pixels):
        return np.zeros((0, 32), np.uint8)
    # at half the size a quarter of the pixels describe the same surroundings
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    places = (0.5 * pixels.astype(np.float64) - 0.25).tolist()
    corners = [
        cv2.KeyPoint(x, y, _SIFT_SIZE_PX / 2, float(angle))
        for (x, y), angle in zip(places, _directions_deg(grey, pixels), strict=True)
    ]
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
    return np.rad2deg(np.arctan2(down, right)) % 360.0
