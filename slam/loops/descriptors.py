"""Features of a frame for loop closure: ORB (Rublee et al. 2011) and 3-D points from learned depth."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import DepthMap, Descriptors, Frame, Grey, Intrinsics, View, nearest_depth, trusted_depth

_CELL_PX = 32
_DETECTED_PER_KEPT = 4
_EDGE_PX = 16
_CORNER_CONTRAST = 10  # least contrast of a corner, grey levels
_MAX_FEATURES = 500  # largest number of corners kept of a frame


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

    def view(self, frame: Frame, depth_unscaled: DepthMap, height_unscaled: float | None = None) -> View:
        """Features of a frame, at the size of its image.

        Args:
            frame: the frame, at the size of the intrinsics.
            depth_unscaled: its learned z-depth ``(H, W)``.
            height_unscaled: camera height in the same unit (see `trusted_depth`).
        """
        pixels, descriptors = self.corners(frame.grey)
        z = trusted_depth(nearest_depth(depth_unscaled, pixels), height_unscaled)
        points = self._intrinsics.rays(pixels) * z[:, None]
        return View(frame.index, pixels, descriptors, points.astype(np.float32))

    def corners(self, grey: Grey) -> tuple[NDArray[np.float32], Descriptors]:
        """Pixels ``(M, 2)`` and descriptors ``(M, 32)``."""
        detected = self._orb.detect(grey, None)
        strongest = _strongest_per_cell(detected, grey.shape, _MAX_FEATURES)
        chosen, descriptors = self._orb.compute(grey, [detected[k] for k in strongest])
        if not chosen:
            return np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8)
        return np.array([keypoint.pt for keypoint in chosen], np.float32), descriptors


def hamming(first: Descriptors, second: Descriptors) -> NDArray[np.float32]:
    """Differing bits ``(M, N)`` of every pair of descriptors ``(M, 32)`` and ``(N, 32)``."""
    words_first, words_second = (np.ascontiguousarray(d).view(np.uint64).T for d in (first, second))  # (4, M), (4, N)
    differing = np.zeros((len(first), len(second)), np.uint16)
    for a, b in zip(words_first, words_second, strict=True):
        differing += np.bitwise_count(a[:, None] ^ b)
    return differing.astype(np.float32)


def _strongest_per_cell(keypoints: Sequence[cv2.KeyPoint], shape: tuple[int, ...], count: int) -> NDArray[np.intp]:
    """Rows of at most ``count`` keypoints: the best of every cell first, then the second best, and so on."""
    if len(keypoints) == 0:
        return np.zeros(0, np.intp)
    pixels = np.array([k.pt for k in keypoints])
    response = np.array([k.response for k in keypoints])
    cell = (pixels[:, 1] // _CELL_PX).astype(int) * (shape[1] // _CELL_PX + 1) + (pixels[:, 0] // _CELL_PX).astype(int)
    by_cell = np.lexsort((-response, cell))
    first_of_cell = np.searchsorted(cell[by_cell], cell[by_cell])
    rank = np.arange(len(by_cell)) - first_of_cell
    order = by_cell[np.lexsort((-response[by_cell], rank))]
    return np.asarray(order[:count])
