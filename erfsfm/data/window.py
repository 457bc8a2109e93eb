"""Windows of consecutive frames, what is known of them, and the cache that their images are read through.

A file that cannot be read costs the windows that hold it, not a night of training.
"""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from math import prod
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from erfsfm.common.errors import DataError
from erfsfm.data.recordings import Recording

logger = logging.getLogger(__name__)

HEIGHTS = 10.0  # camera heights in the networks' unit of depth: steps are then as small as initial outputs
_MOST_IN_A_ROW = 20

T = TypeVar("T")
_BLOCK = 128  # arrays of the cache that are stored together


@dataclass(frozen=True)
class Snippet:
    """A window: frames ``first`` to ``first + length - 1`` of a recording."""

    recording: Recording
    first: int


@dataclass(frozen=True)
class TeacherStructure:
    """What is known of depth and motion of a snippet, as labels for both networks, in heights of the camera.

    Attributes:
        T_source_target: ``(N, 4, 4)``, NaN where nothing is known.
        least: smallest inverse depth that agrees with what is known, ``(H, W)``, 0 where unbounded.
        most: largest one, infinite where unbounded.
    """

    T_source_target: NDArray[np.float32]
    least: NDArray[np.floating]
    most: NDArray[np.floating]


def snippet_motion(
    T_world_camera: NDArray[np.float64], first: int, sources: int
) -> NDArray[np.float64]:
    """``T_source_target`` ``(N, 4, 4)`` of the snippet that begins at pose ``first`` of ``(frames, 4, 4)``."""
    target = first + sources // 2
    others = np.delete(np.arange(first, first + sources + 1), sources // 2)
    return np.linalg.inv(T_world_camera[others]) @ T_world_camera[target]


def load_window(cache: ArrayCache, snippet: Snippet, length: int) -> list[NDArray[np.uint8]]:
    """The images ``(H, W, 3)`` of a snippet in time order, of the size that the cache has them in."""
    recording, (height, width, _) = snippet.recording, cache.shape
    return [
        cache.get((*recording.key, index), partial(recording.image, index, height, width))
        for index in range(snippet.first, snippet.first + length)
    ]


def first_readable(snippets: Iterator[Snippet], read: Callable[[Snippet], T]) -> tuple[Snippet, T]:
    """The first snippet that can be read, and what was read of it; a warning says why others are passed over.

    Raises:
        DataError: twenty in a row cannot be read.
    """
    for snippet in islice(snippets, _MOST_IN_A_ROW):
        try:
            return snippet, read(snippet)
        except DataError as error:
            reason = str(error)
            logger.warning("%s: snippets with it are passed over", reason)
    raise DataError(f"{_MOST_IN_A_ROW} snippets in a row cannot be read, the last: {reason}")


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
        self.shape = shape
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
            slot = (
                len(self._slots)
                if len(self._slots) < self._capacity
                else self._slots.popitem(last=False)[1]
            )
            self._place(slot)[:] = array
            self._slots[key] = slot
        return array

    def _place(self, slot: int) -> NDArray[Any]:
        block, row = divmod(slot, _BLOCK)
        if block == len(self._blocks):
            arrays = min(_BLOCK, self._capacity - slot)
            self._blocks.append(np.empty((arrays, *self.shape), self._dtype))
        return self._blocks[block][row]
