"""Files by their numbers: rows, gaps, parts, and the rows of files beside them."""

from __future__ import annotations

from pathlib import Path

import pytest

from erfsfm.common.readers.numbering import by_number


def named(*stems: str) -> list[Path]:
    return [Path(f"{stem}.png") for stem in stems]


def test_gaps_and_parts() -> None:
    files = by_number(named("000017", "000018", "000021", "000022", "000024"))
    assert (len(files), files.first, files.rows) == (8, 17, (0, 1, 4, 5, 7))
    assert files.gaps() == [(2, 3), (6, 6)]
    assert files.parts() == [(0, 2), (2, 4), (4, 5)]
    assert [files.file_name(row) for row in (1, 2, 3, 4, 6)] == [
        f"0000{n}.png" for n in (18, 19, 20, 21, 23)
    ]
    assert (
        files.describe_gaps()
        == "3 of 8 frames have no image; the first gap is 000019.png to 000020.png"
    )


@pytest.mark.parametrize(
    ("values", "rows", "skipped"),
    [
        (5, [0, 1, 2, 3, 4], 0),
        (22, [0, 1, 2, 3, 4], 17),
        (4, [0, 1, 3, 4], 0),
        (6, None, None),
        (3, None, None),
    ],
    ids=["one a row", "one a number from 0", "one a file", "too many", "too few"],
)
def test_rows_of_accompanying_files(
    values: int, rows: list[int] | None, skipped: int | None
) -> None:
    assigned = by_number(named("17", "18", "20", "21")).rows_of(values)
    assert (None if assigned is None else (assigned[0].tolist(), assigned[1])) == (
        None if rows is None else (rows, skipped)
    )
