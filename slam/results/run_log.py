"""``run.log``: the log of the package from the first check of a run to its end."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from logging.handlers import MemoryHandler
from pathlib import Path

_MOST_BUFFERED = 100_000


class RunLog(MemoryHandler):
    """Buffers records until there is a file, then writes each at once."""

    def __init__(self) -> None:
        super().__init__(_MOST_BUFFERED, flushLevel=logging.CRITICAL + 1)

    def begin(self, path: Path) -> None:
        """Write the buffered and all further records to a file."""
        file = _QuietFile(path, encoding="utf-8", errors="backslashreplace")
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        self.setTarget(file)
        self.capacity = 1
        self.flush()

    def failed(self, reason: str) -> None:
        """Write the reason of a failure to the file alone: the caller gets the exception."""
        message = f"the run failed: {reason}"
        self.handle(logging.LogRecord("slam.commands.run.run", logging.ERROR, __file__, 0, message, None, None))


class _QuietFile(logging.FileHandler):
    """On a full disk lines are lost without a message."""

    def handleError(self, record: logging.LogRecord) -> None:
        pass

    def close(self) -> None:
        with suppress(OSError):  # flushes again what a full disk refused
            super().close()


@contextmanager
def run_log() -> Iterator[RunLog]:
    """Add a `RunLog` to the logger of the package."""
    log, root = RunLog(), logging.getLogger("slam")
    level = root.level
    root.addHandler(log)
    root.setLevel(logging.INFO)
    try:
        yield log
    finally:
        root.removeHandler(log)
        root.setLevel(level)
        if log.target is not None:
            log.target.close()
