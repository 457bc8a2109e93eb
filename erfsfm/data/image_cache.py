"""Decoded frames of one size, kept within a number of bytes."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from erfsfm.data.recordings import Recording

_BLOCK = 128  # images


class ImageCache:
    """Least-recently-used cache of decoded frames, up to a size in bytes.

    Frames are stored in large blocks. Stored one by one among the short-lived arrays of a sample they fragment the
    heap: three times their size was measured.

    Args:
        limit_mb: memory for images; 0 keeps none.
        height: of every image.
        width: of every image.
    """

    def __init__(self, limit_mb: int, height: int, width: int) -> None:
        self._size = (height, width)
        self._capacity = limit_mb * 2**20 // (height * width * 3)
        self._blocks: list[NDArray[np.uint8]] = []
        self._slots: OrderedDict[tuple[int, int], int] = OrderedDict()

    def image(self, recording: Recording, index: int) -> NDArray[np.uint8]:
        """One frame ``(H, W, 3)``, decoded at most once while it stays in the cache."""
        key = (id(recording), index)
        slot = self._slots.get(key)
        if slot is not None:
            self._slots.move_to_end(key)
            return self._place(slot).copy()
        image = recording.image(index, *self._size)
        if self._capacity > 0:
            slot = len(self._slots) if len(self._slots) < self._capacity else self._slots.popitem(last=False)[1]
            self._place(slot)[:] = image
            self._slots[key] = slot
        return image

    def _place(self, slot: int) -> NDArray[np.uint8]:
        block, row = divmod(slot, _BLOCK)
        if block == len(self._blocks):
            images = min(_BLOCK, self._capacity - slot)
            self._blocks.append(np.empty((images, *self._size, 3), np.uint8))
        return np.asarray(self._blocks[block][row])
