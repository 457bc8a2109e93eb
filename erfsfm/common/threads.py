"""How many threads libraries may start, and the memory that they work in, without importing torch."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np
import scipy.linalg
from threadpoolctl import threadpool_limits

from erfsfm.common.memory import require_memory

_LINEAR_ALGEBRA_BYTES = 192 * 2**20
_LARGE_MATRIX = 64  # rows; smaller ones are decomposed without it


def usable_cores() -> int:
    """Those that this process may run on, or what ``OMP_NUM_THREADS`` says, as PyTorch counts them."""
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    if wanted.isdecimal() and int(wanted) > 0:
        return int(wanted)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def opencv_threads(count: int) -> Iterator[None]:
    """OpenCV computes in so many threads; with one, in the calling thread alone.

    Its threads also have to end before a process is forked: the child would wait forever for threads that it lacks.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def stay_single_threaded() -> None:
    """Start no threads in this process from here on, which is one of as many as there are cores."""
    os.environ["OMP_NUM_THREADS"] = "1"  # read when other libraries are loaded, and by `usable_cores`
    cv2.setNumThreads(1)
    threadpool_limits(1)


def take_working_memory() -> None:
    """Let linear algebra take its memory now: later, where none is left, OpenCV would end the process, and OpenBLAS,
    of which NumPy and SciPy have one each, would wait for ever.

    Raises:
        MemoryError: there is not enough.
    """
    require_memory(_LINEAR_ALGEBRA_BYTES)
    matrix = np.random.default_rng(0).normal(size=(_LARGE_MATRIX, _LARGE_MATRIX))
    cv2.SVDecomp(matrix)
    np.linalg.svd(matrix @ matrix)
    scipy.linalg.svd(matrix)


@contextmanager
def limit_library_threads() -> Iterator[None]:
    """OpenCV and BLAS compute in the calling threads alone, for programs that run several threads of their own."""
    with opencv_threads(1), threadpool_limits(1, "blas"):
        yield
