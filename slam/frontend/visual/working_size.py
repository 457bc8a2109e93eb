"""The size of image at which corners are measured: the recording's own, of large images a megapixel.

All bounds in pixels are for images of a tenth of a megapixel to a whole one. Larger images are no sharper: a pixel of
theirs has more noise and less contrast, corners crowd on few objects, and the time grows with the pixels.
"""

from __future__ import annotations

import cv2
import numpy as np

from slam.frames import DepthMap, Frame, Image, Intrinsics, resized_depth

_MOST_PIXELS = 1e6


class WorkingSize:
    """Reduces images and depth of one camera; those of at most a megapixel stay as they are."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        """``camera`` is that of the reduced images."""
        ratio = float(np.sqrt(_MOST_PIXELS / (intrinsics.width * intrinsics.height)))
        size = round(ratio * intrinsics.width), round(ratio * intrinsics.height)
        self.camera = intrinsics if ratio >= 1.0 else intrinsics.resized(*size)
        self._size = self.camera.width, self.camera.height

    def frame(self, frame: Frame) -> Frame:
        """The frame with its reduced image."""

        def reduced() -> Frame:
            image: Image = np.asarray(cv2.resize(frame.image, self._size, interpolation=cv2.INTER_AREA), np.uint8)
            return Frame(frame.index, frame.stamp, image)

        return frame if frame.image.shape[1::-1] == self._size else frame.derived(("reduced", self._size), reduced)

    def depth(self, depth: DepthMap) -> DepthMap:
        """The depth map ``(h, w)`` of the reduced image."""
        return depth if depth.shape[::-1] == self._size else resized_depth(depth, *self._size)
