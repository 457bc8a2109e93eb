"""Rows of a table that somebody else wrote: what is read as text and numbers, and the rule for bad ones.

A bad row is left out and said, and does not cost the recording.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.files import read_text
from slam.geometry.se3 import Rows
from slam.runtime.errors import SlamError

logger = logging.getLogger(__name__)

_LEAST_IN_ORDER = 0.75  # share of the rows; with fewer, nobody knows which of them are out of order
_MOST_PLACES_LATE = 5
# digits of milli- and microseconds since 1970, and how many are behind the point
_FRACTIONS = {13: 3, 16: 6}
_NANOSECOND_DIGITS = 15  # at least


class BadRows:
    """The rows of one file that are left out, with a reason each, and the rule for all tables.

    A row that cannot be read, or whose stamp repeats another's or is far from its place, is left out. One warning
    counts them and names the first. The file is refused where nothing is left, or where the order is ambiguous.
    """

    def __init__(self, path: Path | str, error: type[SlamError]) -> None:
        """Of a file at ``path``, which ``error`` refuses."""
        self._path, self._error = path, error
        self._reasons: dict[int, str] = {}

    def __len__(self) -> int:
        return len(self._reasons)

    def add(self, line: int, reason: str) -> None:
        """Leave out the row on this line."""
        self._reasons.setdefault(line, reason)

    def without(
        self, checks: Sequence[tuple[Any, str]], lines: Rows, *columns: Any
    ) -> tuple[Any, ...]:
        """Lines ``(N,)`` and columns ``(N, ...)`` of the rows that pass all checks ``(N,)``; others have the reason."""
        for is_good, reason in checks:
            for line in lines[~is_good].tolist():
                self.add(line, reason)
        are_good = np.all([is_good for is_good, _ in checks], axis=0)
        return tuple(column[are_good] for column in (lines, *columns))

    def in_order(self, stamps: NDArray[np.float64], what: str, lines: Rows, wanted: str) -> Rows:
        """The rows in the order of their stamps ``(N,)``, without repeated ones and those far from their place.

        A row a few places late is sorted in, and so are all rows of a table in no order at all. Bad rows are said. A
        file of which more than a quarter would be left out is refused, and so is one without a ``wanted`` row (`say`).

        Args:
            stamps: of the rows ``(N,)``.
            what: the stamps are called, for messages.
            lines: on which the rows are ``(N,)``.
            wanted: a good row, for messages.

        Raises:
            SlamError: of the kind of this table: the order is ambiguous, or no row is left.
        """
        order = np.argsort(stamps, kind="stable")
        has_no_order = len(order) > 1 and np.mean(np.diff(stamps) < 0) > 1 - _LEAST_IN_ORDER
        bad = np.abs(order - np.arange(len(order))) > (
            len(order) if has_no_order else _MOST_PLACES_LATE
        )
        bad[1:] |= np.diff(stamps[order]) == 0
        for line in lines[order[bad]].tolist():
            self.add(line, f"{what} must increase")
        if bad.sum() > (1 - _LEAST_IN_ORDER) * len(bad):
            line = int(lines[order[bad]].min())
            raise self._error(
                f"{self._path}, line {line}: {what} must increase; sort the rows, a series a file"
            )
        good = order[~bad]
        self.say(len(good), wanted)
        late = np.flatnonzero(np.diff(good) < 0)
        if len(late):
            line = int(lines[good[late + 1]].min())
            logger.warning(
                "%s: %s are not in order, first on line %d: the rows are sorted",
                self._path,
                what,
                line,
            )
        return good

    def say(self, left: int, wanted: str) -> None:
        """Warn of the rows left out; refuse the file where none of those ``wanted`` is ``left``.

        Args:
            left: number of good rows.
            wanted: a good row, for messages.

        Raises:
            SlamError: of the kind of this table: no row is left.
        """
        line, reason = min(self._reasons.items(), default=(0, ""))
        if not left:
            where = f", line {line}: {reason}" if reason else ": there is no row in this file"
            raise self._error(f"{self._path}{where}; wanted {wanted}")
        if self._reasons:
            total = left + len(self._reasons)
            logger.warning(
                "%s: %d of %d rows are left out; line %d: %s",
                self._path,
                len(self._reasons),
                total,
                line,
                reason,
            )


def text_of(path: Path, error: type[SlamError], wanted: str) -> str:
    """The text of a file that should hold what is ``wanted``.

    Args:
        path: of the file.
        error: the kind of error that is raised.
        wanted: what it should hold, for the message.

    Raises:
        SlamError: of the given kind: there is no such file, or it is no text.
    """
    try:
        return read_text(path)
    except FileNotFoundError as cause:
        raise error(f"{path}: no such file; wanted {wanted}") from cause
    except (OSError, UnicodeDecodeError) as cause:
        reason = getattr(cause, "strerror", None) or "this is not a text file (UTF-8)"
        raise error(f"{path}: {reason}; wanted {wanted}") from cause


def rows_of(path: Path, error: type[SlamError], wanted: str) -> list[tuple[int, str]]:
    """Line numbers and texts of the rows of a table, without blank lines and comments.

    Args:
        path: of the file.
        error: the kind of error that is raised.
        wanted: what it should hold, for the message.

    Raises:
        SlamError: of the given kind: as `text_of`.
    """
    lines = enumerate(map(str.strip, text_of(path, error, wanted).splitlines()), start=1)
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def is_number(word: str) -> bool:
    """Whether Python reads a number, without its underscores."""
    try:
        return "_" not in word and float(word) is not None
    except ValueError:
        return False


def number_or_nan(word: str) -> float:
    """A number; NaN where the word is none."""
    return float(word) if is_number(word) else math.nan


def in_seconds(word: str) -> str:
    """A stamp as a number of seconds; whole milli- and microseconds since 1970 and nanoseconds have their point set."""
    word = word.strip()
    places = _FRACTIONS.get(len(word), 9 if len(word) >= _NANOSECOND_DIGITS else 0)
    return f"{word[:-places]}.{word[-places:]}" if places and word.isdecimal() else word
