"""``run.log``: the log of the package from the first check of a run to its end."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO


class RunLog(logging.Handler):
    """Buffers records until there is a file, then writes each at once.

    Of those that give one reason again and again the first is written, and at the end their number. On a full disk
    lines are lost without a message.
    """

    def __init__(self) -> None:
        super().__init__()
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        self._waiting: list[logging.LogRecord] = []
        self._times: Counter[tuple[str, str]] = Counter()
        self._file: TextIO | None = None

    def begin(self, path: Path) -> None:
        """Write the buffered and all further records to a file."""
        self._file = path.open("a", encoding="utf-8", errors="backslashreplace")
        for record in self._waiting:
            self._write(record)

    def emit(self, record: logging.LogRecord) -> None:
        """Write or buffer a record."""
        reason = record.args[-1] if isinstance(record.args, tuple) and record.args else None
        if record.levelno == logging.INFO and isinstance(reason, str):
            self._times[record.msg, reason] += 1
            if self._times[record.msg, reason] > 1:
                return
        self._write(record)

    def failed(self, reason: str) -> None:
        """Write the reason of a failure to the file alone: the caller gets the exception."""
        self._say(logging.ERROR, f"the run failed: {reason}")

    def close(self) -> None:
        """Write how often reasons were given again and again, and close the file."""
        for (_, reason), times in self._times.items():
            if times > 1:
                self._say(logging.INFO, f"{times} times: {reason}")
        if self._file is not None:
            with suppress(OSError):  # flushes again what a full disk refused
                self._file.close()
        super().close()

    def _say(self, level: int, message: str) -> None:
        self._write(logging.LogRecord("slam.commands.run", level, __file__, 0, message, None, None))

    def _write(self, record: logging.LogRecord) -> None:
        if self._file is None:
            self._waiting.append(record)
            return
        with suppress(Exception):
            self._file.write(f"{self.format(record)}\n")
            self._file.flush()


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
