"""Files by their numbers: rows, gaps, parts, and the rows of files beside them."""

from __future__ import annotations

from pathlib import Path

import pytest

from erfsfm.common.errors import DataError
from erfsfm.common.readers.numbering import NumberedFiles, by_name, by_number


def named(*stems: str) -> list[Path]:
    return [Path(f"{stem}.png") for stem in stems]


def test_gaps_and_parts() -> None:
    files = by_number(named("000017", "000018", "000021", "000022", "000024"))
    assert (len(files), files.first, files.rows) == (8, 17, (0, 1, 4, 5, 7))
    assert files.gaps() == [(2, 3), (6, 6)]
    assert files.parts() == [(0, 2), (2, 4), (4, 5)]
    assert [files.file_name(row) for row in (1, 2, 3, 4, 6)] == [f"0000{n}.png" for n in (18, 19, 20, 21, 23)]
    assert files.describe_gaps() == "3 of 8 frames have no image; the first gap is 000019.png to 000020.png"


@pytest.mark.parametrize(
    ("values", "rows", "skipped"),
    [(5, [0, 1, 2, 3, 4], 0), (22, [0, 1, 2, 3, 4], 17), (4, [0, 1, 3, 4], 0), (6, None, None), (3, None, None)],
    ids=["one a row", "one a number from 0", "one a file", "too many", "too few"],
)
def test_rows_of_accompanying_files(values: int, rows: list[int] | None, skipped: int | None) -> None:
    assigned = by_number(named("17", "18", "20", "21")).rows_of(values)
    assert (None if assigned is None else (assigned[0].tolist(), assigned[1])) == (
        None if rows is None else (rows, skipped)
    )


@pytest.mark.parametrize(
    ("stems", "message"),
    [
        (("000000", "extra"), r"extra\.png is not named by its number \(000000\.png\): rename it"),
        (("0001", "001"), "0001.png and 001.png have the same number"),
    ],
)
def test_names_without_numbers(stems: tuple[str, ...], message: str) -> None:
    with pytest.raises(DataError, match=message):
        by_number(named(*stems))


@pytest.mark.parametrize(
    "stems",
    [
        ["a", "b", "d"],
        ["0", "5", "10", "15"],
        ["frame_07", "frame_08", "frame_09"],
        ["left_1", "right_2", "right_3", "right_5"],
        ["1305031102.175304", "1305031102.211214", "1305031102.243211"],
        ["only"],
    ],
)
def test_folders_without_gaps(stems: list[str]) -> None:
    files = by_name(named(*stems))
    assert (len(files), files.first, files.gaps()) == (len(stems), 0, [])


def test_a_huge_gap_takes_no_memory() -> None:
    files = by_name(named("0", "1", "2", "999999999999"))
    assert len(files) == 10**12 and files.parts() == [(0, 3), (3, 4)]
    assert isinstance(files, NumberedFiles)
