"""Work in other processes and threads, a run of the SLAM system as a process, and the threads that libraries start."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import cv2
from threadpoolctl import threadpool_limits

from erfsfm.common.errors import TrainingError

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


_POLL_S = 0.5
_GIB = 2**30
_MOST_SAID = 20_000  # bytes of its standard error that are searched for the reason

S = TypeVar("S")
T = TypeVar("T")

CORES = 2  # used side by side
_FATAL = 4  # level of ONNX Runtime's own log; its errors are raised as well


@contextmanager
def processes(work: str) -> Iterator[ProcessPoolExecutor]:
    """As many processes as there are cores, each of one thread; after an error, what they have not begun is left.

    Raises:
        TrainingError: one of the processes was killed.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), context, stay_single_threaded) as pool:
        try:
            yield pool
        except BrokenProcessPool as error:
            raise TrainingError(
                f"a process that {work} was killed: is there enough memory?"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)


def slam_process(
    arguments: Sequence[str],
    folder: Path | None = None,
    log: Path | None = None,
    threads: int = 0,
    memory_gib: float = 0.0,
    program: Sequence[str] = ("slam",),
    variables: Mapping[str, str] | None = None,
) -> str:
    """Run ``erfsfm-slam ARGUMENTS`` with this interpreter, and wait for its end; why it failed, if it did.

    Args:
        arguments: of the command line.
        folder: from which its paths are seen.
        log: file that its standard error is added to.
        threads: of libraries; 0 as they like.
        memory_gib: where it needs more, it is ended; 0 for no limit.
        program: module that is run, with words before the arguments.
        variables: of its environment, beside those of this process.
    """
    limits = dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(threads)
    )
    with tempfile.TemporaryFile("w+b") if log is None else log.open("a+b") as said:
        process = subprocess.Popen(
            [sys.executable, "-Pm", *program, *arguments],
            cwd=folder,
            env=os.environ | (limits if threads else {}) | dict(variables or {}),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=said,
        )
        try:
            exceeded = _watch(process, memory_gib)
        finally:
            process.kill()
            process.wait()
        said.seek(max(said.seek(0, os.SEEK_END) - _MOST_SAID, 0))
        lines = said.read().decode(errors="replace").strip().splitlines()
    code = process.returncode
    if exceeded or code == 0:
        return exceeded
    if code < 0:
        return f"killed by {signal.Signals(-code).name}"
    return lines[-1].removeprefix("erfsfm-slam: ") if lines else f"exit code {code}"


def _watch(process: subprocess.Popen[bytes], memory_gib: float) -> str:
    """Wait for a process; a reason where it used too much memory and is to be ended."""
    while True:
        try:
            process.wait(_POLL_S)
            return ""
        except subprocess.TimeoutExpired:
            used = 0.0
            with suppress(
                OSError, IndexError, ValueError
            ):  # it has ended, or the system tells nothing
                pages = int(
                    Path(f"/proc/{process.pid}/statm").read_text(encoding="ascii").split()[1]
                )
                used = pages * os.sysconf("SC_PAGE_SIZE") / _GIB
            if 0 < memory_gib < used:
                return f"it used {used:.1f} GiB of memory, more than the {memory_gib:.1f} GiB of --memory"


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
    os.environ["OMP_NUM_THREADS"] = (
        "1"  # read when other libraries are loaded, and by `usable_cores`
    )
    cv2.setNumThreads(1)
    threadpool_limits(1)


@contextmanager
def limit_library_threads() -> Iterator[None]:
    """OpenCV and BLAS compute in the calling threads alone, for programs that run several threads of their own."""
    with opencv_threads(1), threadpool_limits(1, "blas"):
        yield


def open_session(content: bytes, threads: int) -> InferenceSession:
    """A graph that is ready to run on that many threads; the exceptions of ONNX Runtime are raised as they are."""
    from onnxruntime import InferenceSession, SessionOptions

    options = SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _FATAL
    options.add_session_config_entry(
        "session.intra_op.allow_spinning", "0"
    )  # costly on a shared machine
    return InferenceSession(content, options, providers=["CPUExecutionProvider"])


def read_ahead(
    read: Callable[[int], T], numbers: Sequence[int], threads: int = 1
) -> Generator[T, None, None]:
    """The result of ``read`` for each number, computed in other ``threads`` while the one before is used.

    They end with the numbers, or when the generator is closed. With more than one, calls must be independent.
    """
    with ThreadPoolExecutor(max_workers=threads, thread_name_prefix="ahead") as ahead:
        waiting: deque[Future[T]] = deque()
        for number in numbers:
            waiting.append(ahead.submit(read, number))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        for last in waiting:
            yield last.result()


def side_by_side(do: Callable[[S], T], items: Iterable[S]) -> list[T]:
    """The result of ``do`` for each item, in order; the calls must be independent."""
    with ThreadPoolExecutor(max_workers=CORES, thread_name_prefix="side") as side:
        return list(side.map(do, items))
