"""``run.log``: the log of the package from the first check of a run to its end."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


class RunLog(logging.Handler):
    """Buffers records until there is a file, then writes each at once.

    On a full disk lines are lost without a message.
    """

    def __init__(self) -> None:
        super().__init__()
        self._kept: list[logging.LogRecord] = []
        self._file: _QuietFile | None = None

    def begin(self, path: Path) -> None:
        """Write the buffered and all further records to a file."""
        self._file = _QuietFile(path, encoding="utf-8", errors="backslashreplace")
        self._file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        for record in self._kept:
            self._file.emit(record)
        self._kept.clear()

    def emit(self, record: logging.LogRecord) -> None:
        """Write or buffer a record."""
        if self._file is None:
            self._kept.append(record)
        else:
            self._file.emit(record)

    def failed(self, reason: str) -> None:
        """Write the reason of a failure to the file alone: the caller gets the exception."""
        message = f"the run failed: {reason}"
        self.handle(logging.LogRecord("slam.commands.run.run", logging.ERROR, __file__, 0, message, None, None))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
        super().close()


class _QuietFile(logging.FileHandler):
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
        log.close()
