"""Files by their numbers: rows, gaps, parts, and the rows of files beside them."""

from __future__ import annotations

from pathlib import Path

import pytest

from erfsfm.common.errors import DataError
from erfsfm.common.readers.numbering import by_name, by_number


def named(*stems: str) -> list[Path]:
    return [Path(f"{stem}.png") for stem in stems]


def test_gaps_and_parts():
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
def test_rows_of_accompanying_files(values: int, rows: list[int] | None, skipped: int | None):
    assigned = by_number(named("17", "18", "20", "21")).rows_of(values)
    assert (None if assigned is None else (assigned[0].tolist(), assigned[1])) == (
        None if rows is None else (rows, skipped)
    )


@pytest.mark.parametrize("twin", ["{}_mask", "depth{}", "{}_right"])
def test_images_of_two_kinds_in_one_folder_are_named(twin: str):
    stems = [f"{k:04d}" for k in range(8)]
    both = [stem for k in stems for stem in (k + "_left" * ("right" in twin), twin.format(k))]
    with pytest.raises(DataError, match=r"several images of one number, such as 0000.* and .*0000"):
        by_name(named(*both))
    assert len(by_name(named("run1_a", "run1_b", "run1_c", "run1_d", "run1_e"))) == 5
