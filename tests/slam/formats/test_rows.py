"""Rows of tables that somebody else wrote: what costs a row, what is sorted, and what is read as a stamp."""

from pathlib import Path

import numpy as np
import pytest

from slam.formats.trajectory import read_trajectory


@pytest.mark.parametrize(
    "bad",
    [
        *(
            "0.25 1 2",
            "0.25 1 2 3 nan 0 0 1",
            "0.25 1 2 3 0 0 0 0",
            "0.25 1 2 1e13 0 0 0 1",
            "0.2 1 2 3 0 0 0 1",
        ),
        *("0.1 1 2 3 0 0 0 1", "0.25 1 two 3 0 0 0 1", "1 0 0 1.5 0 1 0 2.5 0 0 1 3.5"),
    ],
)
def test_a_bad_row_costs_itself_alone(tmp_path: Path, bad: str, caplog: pytest.LogCaptureFixture):
    rows = [f"{0.1 * k:.1f} {k} 0 0 0 0 0 1" for k in range(6)]
    path = tmp_path / "poses.txt"
    path.write_text("\n".join([*rows[:3], bad, *rows[3:], "0.9 1"]))
    read = read_trajectory(path)
    np.testing.assert_array_equal(read.positions[:, 0], range(6))
    assert len(caplog.messages) == 1 and "2 of 8 rows" in caplog.text and "line 4" in caplog.text


@pytest.mark.parametrize("separator", [",", ";", ", ", "\t"])
@pytest.mark.parametrize(
    ("unit", "form"), [(1, "{:.6f}"), (10**3, "{:.0f}"), (10**6, "{:.0f}"), (10**9, "{:.0f}")]
)
def test_tables_of_others(tmp_path: Path, separator: str, unit: int, form: str):
    """Another separator, and stamps since 1970 in another unit, rows in no order."""
    stamps = [1403715273.5, 1403715273.25, 1403715274.0, 1403715273.0]
    w_last = unit != 10**9 or separator == "\t"  # separated nanoseconds are EuRoC's, with w x y z
    rows = [
        [form.format(t * unit), f"{t - stamps[0]}", "0", "0", *("0001" if w_last else "1000")]
        for t in stamps
    ]
    (tmp_path / "t").write_text("t x y z\n" + "\n".join(separator.join(row) for row in rows))
    found = read_trajectory(tmp_path / "t")
    np.testing.assert_allclose(found.stamps, sorted(stamps), atol=1e-3)
    np.testing.assert_allclose(
        found.positions[:, 0], np.array(sorted(stamps)) - stamps[0], atol=1e-6
    )
