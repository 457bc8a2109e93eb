"""Time and memory of a run; arrays spilled to a temporary file, which limits the memory of a long drive."""

from __future__ import annotations

import ctypes
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from slam.runtime.errors import SlamError

T = TypeVar("T")


class Stopwatch:
    """Wall-clock seconds by stage, processor seconds and peak memory of the whole process."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._cpu_start = time.process_time()
        self.stages: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of the block to a stage; a stage may be entered many times.

        Stages are measured in the main thread, so that they add up: work in another thread counts as long as the
        main thread waits for it.
        """
        start = time.perf_counter()
        try:
            yield
        finally:
            self.stages[name] = self.stages.get(name, 0.0) + time.perf_counter() - start

    def each(self, name: str, items: Iterator[T]) -> Iterator[T]:
        """The items; the time to wait for each belongs to a stage."""
        while True:
            with self.stage(name):
                item = next(items, None)
            if item is None:
                return
            yield item

    @property
    def seconds(self) -> float:
        """Wall-clock seconds since the start."""
        return time.perf_counter() - self._start

    @property
    def cpu_seconds(self) -> float:
        """Processor seconds, user and system, since the start."""
        return time.process_time() - self._cpu_start


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
        self._end = 0
        self._lock = Lock()  # the file has one position, which every write and read moves

    def put(self, array: NDArray[Any]) -> SpilledArray:
        """Write an array."""
        content = np.ascontiguousarray(array)
        try:
            with self._lock:
                start = self._end
                self._file.seek(start)
                self._file.write(content.data)
                self._file.flush()
                self._end += content.nbytes
        except OSError as error:
            raise SlamError(
                f"{self._what} cannot be kept in {tempfile.gettempdir()} ({error.strerror or error}): "
                "make room, set TMPDIR or switch fusion off (mapping.enabled=false)"
            ) from error
        return SpilledArray(self, start, content.shape, content.dtype)

    def read(self, start: int, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
        """An array that was put at ``start``."""
        count = int(np.prod(shape))
        try:
            with self._lock:
                self._file.seek(start)
                return np.fromfile(self._file, dtype, count).reshape(shape)
        except (OSError, ValueError) as error:
            raise SlamError(
                f"{self._what} in {tempfile.gettempdir()} cannot be read ({error}): run again"
            ) from error


@dataclass(frozen=True)
class SpilledArray:
    """An array in a spill file: its place, shape and type."""

    spill_file: SpillFile
    start: int
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    def read(self) -> NDArray[Any]:
        """The array, as it was put."""
        return self.spill_file.read(self.start, self.shape, self.dtype)
