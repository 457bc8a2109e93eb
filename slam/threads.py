"""What goes on in other threads, and how many of them libraries may use."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import cv2
from threadpoolctl import threadpool_limits

T = TypeVar("T")


def read_ahead(read: Callable[[int], T], count: int) -> Iterator[T]:
    """What ``read`` gives for 0, 1, ... ``count`` - 1, each read in another thread while the one before is used."""
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="ahead") as ahead:
        following = ahead.submit(read, 0) if count else None
        for index in range(count):
            assert following is not None
            current = following.result()
            if index + 1 < count:
                following = ahead.submit(read, index + 1)
            yield current


@contextmanager
def one_thread_each() -> Iterator[None]:
    """BLAS and OpenCV without threads of their own.

    A run computes in several threads already; matrices and images are small, and more would only wait for each other.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1, "blas"):
            yield
    finally:
        cv2.setNumThreads(threads)
