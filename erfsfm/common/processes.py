"""Work in other processes: spread over several of this program, or a run of the SLAM system."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from pathlib import Path

from erfsfm.common.errors import TrainingError
from erfsfm.common.threads import stay_single_threaded

_POLL_S = 0.5
_GIB = 2**30
_MOST_SAID = 20_000  # bytes of its standard error that are searched for the reason


@contextmanager
def processes(work: str) -> Iterator[ProcessPoolExecutor]:
    """As many processes as there are cores, each of one thread; after an error, what they have not begun is left."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), context, stay_single_threaded) as pool:
        try:
            yield pool
        except BrokenProcessPool as error:
            raise TrainingError(f"a process that {work} was killed: is there enough memory?") from error
        finally:
            pool.shutdown(cancel_futures=True)


def slam_process(
    arguments: Sequence[str],
    folder: Path | None = None,
    log: Path | None = None,
    threads: int = 0,
    memory_gib: float = 0.0,
    program: Sequence[str] = ("slam",),
) -> str:
    """Run ``erfsfm-slam ARGUMENTS`` with this interpreter, and wait for its end; why it failed, if it did.

    Args:
        arguments: of the command line.
        folder: from which its paths are seen.
        log: file that its standard error is added to.
        threads: of libraries; 0 as they like.
        memory_gib: where it needs more, it is ended; 0 for no limit.
        program: module that is run, with words before the arguments.
    """
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
    with tempfile.TemporaryFile("w+b") if log is None else log.open("a+b") as said:
        process = subprocess.Popen(
            [sys.executable, "-Pm", *program, *arguments],
            cwd=folder,
            env=os.environ | (limits if threads else {}),
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
        lines = [line.strip() for line in said.read().decode(errors="replace").splitlines() if line.strip()]
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
            with suppress(OSError, IndexError, ValueError):  # it has ended, or the system tells nothing
                pages = int(Path(f"/proc/{process.pid}/statm").read_text(encoding="ascii").split()[1])
                used = pages * os.sysconf("SC_PAGE_SIZE") / _GIB
            if 0 < memory_gib < used:
                return f"it used {used:.1f} GiB of memory, more than the {memory_gib:.1f} GiB of --memory"
