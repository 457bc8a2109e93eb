"""Decoded frames of one size, kept within a number of bytes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from erfsfm.data.array_cache import ArrayCache
from erfsfm.data.recordings import Recording


class ImageCache:
    """Least-recently-used cache of decoded frames, up to a size in bytes.

    Args:
        limit_mb: memory for images; 0 keeps none.
        height: of every image.
        width: of every image.
    """

    def __init__(self, limit_mb: int, height: int, width: int) -> None:
        self._size = (height, width)
        self._images = ArrayCache(limit_mb, (height, width, 3), np.uint8)

    def image(self, recording: Recording, index: int) -> NDArray[np.uint8]:
        """One frame ``(H, W, 3)``, decoded at most once while it stays in the cache."""
        return self._images.get((id(recording), index), lambda: recording.image(index, *self._size))
