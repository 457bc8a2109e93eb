"""Photometric residual of warping by depth and poses, relative to the difference without warping.

It predicts the error of a pose (``erfsfm.pose_noise``). NumPy and OpenCV alone, on small images, for it is computed
for every snippet.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

_SIZE = (104, 32)  # width, height
_LEAST_PIXELS = 100
_NEAREST = np.float32(1e-6)
_LEAST_DIFFERENCE = 1e-3  # grey levels


Thumbnail = NDArray[np.float32]


def thumbnail(grey: NDArray[np.uint8]) -> Thumbnail:
    """Grey levels ``(H, W)`` of a frame at the size at which residuals are computed."""
    return np.asarray(cv2.resize(grey, _SIZE, interpolation=cv2.INTER_AREA), dtype=np.float32)


class PhotometricResidual:
    """Residuals of the snippets of one camera."""

    def __init__(self, K: NDArray[np.float64], width: int, height: int) -> None:
        """Prepare for images of a size.

        Args:
            K: camera matrix ``(3, 3)`` of these images, pixels; (0, 0) is the centre of the top-left pixel.
            width: of the images, pixels.
            height: likewise.
        """
        shrink = np.array([_SIZE[0] / width, _SIZE[1] / height])
        self._focal = (shrink * [K[0, 0], K[1, 1]]).tolist()
        self._centre = (shrink * (K[:2, 2] + 0.5) - 0.5).tolist()
        u, v = np.meshgrid(*(np.arange(side, dtype=np.float64) for side in _SIZE))
        x, y = (u - self._centre[0]) / self._focal[0], (v - self._centre[1]) / self._focal[1]
        self._rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)]).astype(np.float32)  # (3, P)

    def ratios(
        self,
        thumbnails: Sequence[Thumbnail],
        disparity_target: NDArray[np.float32],
        T_source_target: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Mean absolute difference of target and warped source over that of target and source as it is.

        Args:
            thumbnails: of N + 1 frames in time order, the target in the middle.
            disparity_target: 1/depth of the target in the unit of the poses, of any size.
            T_source_target: ``(N, 4, 4)``, target camera to source camera, row k for the k-th source in time order.

        Returns:
            ``(N,)``: 0 if warping explains the whole difference, 1 if none of it, or if too few pixels overlap.
        """
        middle = len(thumbnails) // 2
        target, sources = thumbnails[middle], np.delete(np.stack(thumbnails), middle, axis=0)  # (N, h, w)
        near = cv2.resize(disparity_target, _SIZE, interpolation=cv2.INTER_AREA).ravel()
        R, t = (part.astype(np.float32) for part in (T_source_target[:, :3, :3], T_source_target[:, :3, 3:]))
        x, y, z = (R @ self._rays + t * near).swapaxes(0, 1)  # (N, P) each
        ahead = np.maximum(z, _NEAREST)
        u, v = self._focal[0] * x / ahead + self._centre[0], self._focal[1] * y / ahead + self._centre[1]
        width, height = _SIZE
        both = ((z > 0) & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)).reshape(sources.shape)
        places = zip(sources, u.reshape(sources.shape), v.reshape(sources.shape), strict=True)
        warped = np.stack([cv2.remap(source, columns, rows, cv2.INTER_LINEAR) for source, columns, rows in places])
        pixels = both.sum(axis=(1, 2))
        residual, unwarped = (
            (np.abs(target - other) * both).sum(axis=(1, 2)) / pixels.clip(1) for other in (warped, sources)
        )
        return np.where(pixels < _LEAST_PIXELS, 1.0, residual / np.maximum(unwarped, _LEAST_DIFFERENCE)).astype(
            np.float64
        )
