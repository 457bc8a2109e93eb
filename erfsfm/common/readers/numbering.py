"""Files numbered frame by frame: which number each has, and where numbers are missing.

A missing number is a gap in time, not an error: the frame has no image.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError

_DIGITS = re.compile(r"\d+")
_NUMBERED = re.compile(r"(?P<prefix>.*?)(?P<number>\d+)")


@dataclass(frozen=True)
class NumberedFiles:
    """Files in the order of their numbers. Row k stands for number ``first + k``, whether or not it has a file.

    Attributes:
        paths: the N files that exist, at least one.
        rows: ``(N,)``, increasing from 0, the row of each.
        first: number of row 0, by which files beside these are indexed (times, poses, packets).
        names: of all rows, where a table gives them.
    """

    paths: tuple[Path, ...]
    rows: tuple[int, ...]
    first: int = 0
    names: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Number of rows, those without a file among them."""
        return self.rows[-1] + 1

    def gaps(self) -> list[tuple[int, int]]:
        """Runs of rows without a file, as (first, last)."""
        gaps = []
        for before, after in pairwise(self.rows):
            if after > before + 1:
                gaps.append((before + 1, after - 1))
        return gaps

    def parts(self) -> list[tuple[int, int]]:
        """Runs of files without a gap between them, as half-open ranges of positions in ``paths``."""
        cuts = 1 + np.flatnonzero(np.diff(self.rows) > 1)
        return list(pairwise([0, *cuts.tolist(), len(self.rows)]))

    def file_name(self, row: int) -> str:
        """The name that the file of a row has or would have."""
        if self.names:
            return self.names[row]
        position = max(int(np.searchsorted(self.rows, row, side="right")) - 1, 0)
        path = self.paths[position]
        match = _NUMBERED.fullmatch(path.stem)
        if match is None or self.rows[position] == row:
            return path.name
        number = int(match["number"]) + row - self.rows[position]
        return f"{match['prefix']}{number:0{len(match['number'])}d}{path.suffix}"

    def rows_of(self, values: int) -> tuple[NDArray[np.intp], int] | None:
        """Which rows a file beside these describes, and how many of its first ``values`` belong to none of them.

        It has one for each number from 0, for each row, or for each file; None where the count fits nothing.
        """
        if values in (len(self), self.first + len(self)):
            return np.arange(len(self)), values - len(self)
        if values == len(self.paths):
            return np.array(self.rows, dtype=np.intp), 0
        return None

    def describe_gaps(self) -> str:
        """How many files are missing, and which first."""
        gaps = self.gaps()
        missing = len(self) - len(self.paths)
        first, last = gaps[0]
        where = self.file_name(first) + (f" to {self.file_name(last)}" if last > first else "")
        return f"{missing} of {len(self)} frames have no image; the first gap is {where}"


def by_number(paths: list[Path]) -> NumberedFiles:
    """Files that KITTI names by their number alone, at least one, in order.

    Raises:
        DataError: a name is no number, or two files have the same.
    """
    for path in paths:
        if not path.stem.isdecimal():
            raise DataError(
                f"{path} is not named by its number ({0:0{len(paths[0].stem)}d}{path.suffix}): rename it"
            )
    return _numbered(paths, [int(path.stem) for path in paths])


def by_name(paths: list[Path]) -> NumberedFiles:
    """A user's files, at least one, in order: gaps are detected where names end in numbers that go up one by one.

    Names without a number at their end, stamps and every-n-th-frame numbering have no gaps.

    Raises:
        DataError: many images share their number with another: depth, masks or another camera lie among them.
    """
    by_digits: dict[tuple[str, ...], list[Path]] = {}
    for path in paths:
        by_digits.setdefault(tuple(_DIGITS.findall(path.stem)), []).append(path)
    twins = [same for same in by_digits.values() if len(same) > 1]
    if len(twins) > len(paths) / 4:
        names = " and ".join(path.name for path in twins[0][:2])
        raise DataError(
            f"{paths[0].parent} has several images of one number, such as {names}: masks, depth and other cameras "
            "go into folders of their own"
        )
    numbers: list[int] = []
    prefixes: set[str] = set()
    for path in paths:
        match = _NUMBERED.fullmatch(path.stem)
        if match is None:
            return in_order(paths)
        numbers.append(int(match["number"]))
        prefixes.add(match["prefix"])
    if len(prefixes) > 1 or (len(numbers) > 1 and np.median(np.diff(numbers)) != 1):
        return in_order(paths)
    return replace(_numbered(paths, numbers), first=0)


def in_order(paths: list[Path]) -> NumberedFiles:
    """Files, at least one, one after the other whatever their names are: photos, not a recording."""
    return NumberedFiles(tuple(paths), tuple(range(len(paths))))


def by_table(listed: list[Path], table: Path) -> NumberedFiles:
    """The files that a table lists in the order of time; missing files are gaps.

    Rows before the first file and after the last are left out; ``first`` is the number of rows before the first file.

    Raises:
        DataError: none of the files is there.
    """
    there = [row for row, path in enumerate(listed) if path.is_file()]
    if not there:
        raise DataError(
            f"none of the {len(listed)} images that {table} names is there: unpack them"
        )
    first = there[0]
    names = tuple(path.name for path in listed[first : there[-1] + 1])
    paths = tuple(listed[row] for row in there)
    return NumberedFiles(paths, tuple((np.array(there) - first).tolist()), first, names)


def _numbered(paths: list[Path], numbers: list[int]) -> NumberedFiles:
    for path, after, number, following in zip(paths, paths[1:], numbers, numbers[1:]):
        if following <= number:
            raise DataError(f"{path} and {after.name} have the same number: keep one file a frame")
    return NumberedFiles(tuple(paths), tuple(number - numbers[0] for number in numbers), numbers[0])
