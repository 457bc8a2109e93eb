"""How many threads libraries may start, without importing torch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
from threadpoolctl import threadpool_limits


@contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """OpenCV computes in the calling thread alone.

    Its threads also have to end before a process is forked: the child would wait forever for threads that it lacks.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


@contextmanager
def limit_library_threads() -> Iterator[None]:
    """OpenCV and BLAS compute in the calling threads alone, for programs that run several threads of their own."""
    with single_threaded_opencv(), threadpool_limits(1, "blas"):
        yield
