"""Features of the frames of a drive: ORB (Rublee et al. 2011) at corners of its own."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import (
    DepthMap,
    Descriptors,
    Frame,
    Intrinsics,
    View,
    nearest_depth,
    resized_mask,
    trusted_depth,
)

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
