"""``run.log``: the log of the package from the first check of a run to its end."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


class RunLog(logging.Handler):
    """Buffers records until there is a file, then writes each at once.

    Of those that give one reason again and again the first is written, and at the end their number. On a full disk
    lines are lost without a message.
    """

    def __init__(self) -> None:
        super().__init__()
        self._kept: list[logging.LogRecord] = []
        self._times: Counter[tuple[str, str]] = Counter()
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
        reason = record.args[-1] if isinstance(record.args, tuple) and record.args else None
        if record.levelno == logging.INFO and isinstance(reason, str):
            self._times[record.msg, reason] += 1
            if self._times[record.msg, reason] > 1:
                return
        if self._file is None:
            self._kept.append(record)
        else:
            self._file.emit(record)

    def failed(self, reason: str) -> None:
        """Write the reason of a failure to the file alone: the caller gets the exception."""
        self._say(logging.ERROR, f"the run failed: {reason}")

    def _say(self, level: int, message: str) -> None:
        self.handle(logging.LogRecord("slam.commands.run.run", level, __file__, 0, message, None, None))

    def close(self) -> None:
        """Write how often reasons were given again and again, and close the file."""
        if self._file is not None:
            for (_, reason), times in self._times.items():
                if times > 1:
                    self._say(logging.INFO, f"{times} times: {reason}")
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
