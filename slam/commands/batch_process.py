"""One drive of a batch in a process of its own: ``python -m slam.commands.batch_process LOCK run ...``.

The process ends when its standard input does, that is when the worker that started it dies, and it waits for a lock, so
that two of them never write to one folder.
"""

from __future__ import annotations

import fcntl
import os
import runpy
import signal
import sys
import threading
from pathlib import Path


def _end_with_the_worker() -> None:
    while os.read(0, 1024):  # not sys.stdin, which Python cannot close under a reader as it exits
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    lock = Path(sys.argv.pop(1)).open("w", encoding="utf-8")  # noqa: SIM115 - held until the process ends
    fcntl.flock(lock, fcntl.LOCK_EX)
    threading.Thread(target=_end_with_the_worker, daemon=True).start()
    runpy.run_module("slam", run_name="__main__", alter_sys=True)
