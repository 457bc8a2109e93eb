"""Rows of a table that somebody else wrote: a bad row is left out and said, and does not cost the recording."""

from __future__ import annotations

import logging
import math
from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.runtime.errors import SlamError

logger = logging.getLogger(__name__)

_LEAST_IN_ORDER = 0.75  # share of the rows; with fewer, nobody knows which of them are out of order


class BadRows:
    """The rows of one file that are left out, with a reason each, and the rule for all tables.

    A row that cannot be read, or whose stamp does not follow those of its neighbours, is left out. One warning counts
    them and names the first. The file is refused where nothing is left, or where the order is ambiguous.
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

    def without(self, good: NDArray[np.bool_], reason: str, lines: NDArray[np.intp], *columns: Any) -> Any:
        """Lines ``(N,)`` and columns ``(N, ...)`` of the ``good`` ``(N,)`` rows; the others have this reason."""
        for line in lines[~good].tolist():
            self.add(line, reason)
        return tuple(column[good] for column in (lines, *columns))

    def in_order(self, stamps: NDArray[np.float64], what: str, lines: NDArray[np.intp]) -> NDArray[np.bool_]:
        """The rows ``(N,)`` of the longest series of increasing stamps ``(N,)``; the first of repeated ones.

        Raises:
            SlamError: more than a quarter of the rows would be left out.
        """
        if not len(stamps):
            return np.zeros(0, dtype=bool)
        good = increasing(stamps.tolist())
        for line in lines[~good].tolist():
            self.add(line, f"{what} must increase")
        if good.sum() < _LEAST_IN_ORDER * len(good):
            line = int(lines[~good][0])
            raise self._error(f"{self._path}, line {line}: {what} must increase; sort the rows, a series a file")
        return good

    def ordered(self, rows: Sequence[tuple[int, float, Path]], wanted: str) -> tuple[NDArray[np.float64], list[Path]]:
        """Stamps and files of an index, of its lines with both in the order of time; says which are left out."""
        stamps = np.array([stamp for _, stamp, _ in rows])
        good = self.in_order(stamps, "stamps", np.array([line for line, _, _ in rows], np.intp))
        self.say(int(good.sum()), wanted)
        return stamps[good], [rows[k][2] for k in np.flatnonzero(good)]

    def say(self, left: int, wanted: str) -> None:
        """Warn of the rows left out.

        Args:
            left: number of good rows.
            wanted: what a row should hold.

        Raises:
            SlamError: none is left.
        """
        line, reason = min(self._reasons.items(), default=(0, ""))
        if not left:
            where = f", line {line}: {reason}" if reason else ": there is no row in this file"
            raise self._error(f"{self._path}{where}; wanted {wanted}")
        if self._reasons:
            total = left + len(self._reasons)
            logger.warning(
                "%s: %d of %d rows are left out; line %d: %s", self._path, len(self._reasons), total, line, reason
            )


def increasing(values: Sequence[float]) -> NDArray[np.bool_]:
    """Which of the values ``(N,)`` belong to the longest strictly increasing series; of equal ones the first."""
    ends: list[float] = []  # the smallest last value of a series of each length, and its place
    places: list[int] = []
    before: list[int] = []
    for place, value in enumerate(values):
        length = bisect_left(ends, value)
        before.append(places[length - 1] if length else -1)
        if length == len(ends) or ends[length] != value:
            ends[length : length + 1], places[length : length + 1] = [value], [place]
    chosen = np.zeros(len(values), dtype=bool)
    place = places[-1] if places else -1
    while place >= 0:
        chosen[place] = True
        place = before[place]
    return chosen


def is_number(word: str) -> bool:
    """Whether Python reads a number, without its underscores."""
    try:
        return "_" not in word and float(word) is not None
    except ValueError:
        return False


def number_or_nan(word: str) -> float:
    """A number; NaN where the word is none."""
    return float(word) if is_number(word) else math.nan
