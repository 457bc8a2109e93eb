"""Memory of the process: its peak, what is given back, and arrays spilled to a temporary file.

Spilled arrays limit the memory of a long drive.
"""

from __future__ import annotations

import ctypes
import os
import resource
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.runtime.errors import SlamError

Spilled = Callable[[], NDArray[Any]]
"""Reads an array that was spilled to a file."""


def peak_rss_mb() -> float:
    """Largest resident memory of this process so far, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def return_freed_memory() -> None:
    """Give memory back that glibc's heaps keep: of images and layers of many sizes about 120 kB a frame."""
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)


class SpillFile:
    """An unnamed temporary file, shared by threads; the operating system removes it when the process ends."""

    def __init__(self, what: str = "keyframes") -> None:
        """An empty file; ``what`` names its content in errors."""
        self._what = what
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as this object
        self._lock = Lock()  # the file has one position, which every write and read moves

    def put(self, array: NDArray[Any]) -> Spilled:
        """Write an array, and give what reads it back.

        Raises:
            SlamError: the disk is full.
        """
        content = np.ascontiguousarray(array)
        try:
            with self._lock:
                start = self._file.seek(0, os.SEEK_END)
                self._file.write(content.data)
                self._file.flush()
        except OSError as error:
            raise SlamError(
                f"{self._what} cannot be kept in {tempfile.gettempdir()} ({error.strerror or error}): "
                "make room, set TMPDIR or switch fusion off (mapping.enabled=false)"
            ) from error
        return partial(self._read, start, content.shape, content.dtype)

    def _read(self, start: int, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
        """The array of this ``shape`` and type that begins at the byte ``start``.

        Raises:
            SlamError: the disk cannot be read.
        """
        count = int(np.prod(shape))
        try:
            with self._lock:
                self._file.seek(start)
                return np.fromfile(self._file, dtype, count).reshape(shape)
        except (OSError, ValueError) as error:
            raise SlamError(
                f"{self._what} in {tempfile.gettempdir()} cannot be read ({error}): run again"
            ) from error
