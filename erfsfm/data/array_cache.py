"""Arrays of one shape, and decoded frames of one size, kept within a number of bytes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from math import prod
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from erfsfm.data.recordings import Recording

_BLOCK = 128  # arrays


class ArrayCache:
    """Least-recently-used cache of arrays, up to a size in bytes.

    They are stored in large blocks. Stored one by one among the short-lived arrays of a sample they fragment the heap:
    three times their size was measured.

    Args:
        limit_mb: memory for arrays; 0 keeps none.
        shape: of every array.
        dtype: of every array.
    """

    def __init__(self, limit_mb: int, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        self._shape = shape
        self._dtype = np.dtype(dtype)
        self._capacity = limit_mb * 2**20 // (prod(shape) * self._dtype.itemsize)
        self._blocks: list[NDArray[Any]] = []
        self._slots: OrderedDict[Hashable, int] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], NDArray[Any]]) -> NDArray[Any]:
        """The array of a key, made at most once while it stays in the cache; the caller may change it."""
        slot = self._slots.get(key)
        if slot is not None:
            self._slots.move_to_end(key)
            return self._place(slot).copy()
        array = make()
        if self._capacity > 0:
            slot = len(self._slots) if len(self._slots) < self._capacity else self._slots.popitem(last=False)[1]
            self._place(slot)[:] = array
            self._slots[key] = slot
        return array

    def _place(self, slot: int) -> NDArray[Any]:
        block, row = divmod(slot, _BLOCK)
        if block == len(self._blocks):
            arrays = min(_BLOCK, self._capacity - slot)
            self._blocks.append(np.empty((arrays, *self._shape), self._dtype))
        return np.asarray(self._blocks[block][row])


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
        return self._images.get((*recording.key, index), lambda: recording.image(index, *self._size))
