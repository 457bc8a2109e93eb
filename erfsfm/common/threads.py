"""How many threads libraries may start, and ONNX Runtime on a number of them, without importing torch."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import cv2
from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


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


@contextmanager
def limit_library_threads() -> Iterator[None]:
    """OpenCV and BLAS compute in the calling threads alone, for programs that run several threads of their own."""
    with opencv_threads(1), threadpool_limits(1, "blas"):
        yield


_FATAL = 4  # level of ONNX Runtime's own log; its errors are raised as well


def open_session(content: bytes, threads: int) -> InferenceSession:
    """A graph that is ready to run on that many threads; the exceptions of ONNX Runtime are raised as they are."""
    from onnxruntime import InferenceSession, SessionOptions

    options = SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _FATAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # costly on a shared machine
    return InferenceSession(content, options, providers=["CPUExecutionProvider"])
