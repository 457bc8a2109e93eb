"""One table is written to every kind of output."""

from __future__ import annotations

import csv
import io

import pytest

from erfsfm.common.table import Table, csv_of, table_of

TABLE = Table(["name", "length\nm"], [["a [b] <c>", "1.50"], ["d", "–"]], "one & two", ["a note"])


def test_on_a_terminal_nothing_is_marked_up_or_cut(capsys: pytest.CaptureFixture[str]):
    TABLE.print()
    lines = [line.strip() for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert lines[0] == "one & two" and lines[-1] == "a note"
    assert [line.split() for line in lines[-3:-1]] == [["a", "[b]", "<c>", "1.50"], ["d", "–"]]


def test_markdown_sets_numbers_to_the_right():
    assert TABLE.markdown().splitlines() == [
        "| name | length m |",
        "|---|---:|",
        "| a [b] <c> | 1.50 |",
        "| d | – |",
    ]


def test_html_is_escaped():
    text = TABLE.html()
    assert (
        "<h3>one &amp; two</h3>" in text
        and "<td>a [b] &lt;c&gt;</td>" in text
        and "length<br>m" in text
    )


def test_records_become_a_table_and_csv():
    records = [{"name": "a", "value": 0.12345, "other": None}, {"name": "b, c", "more": 3}]
    table = table_of(records)
    assert table.names == 1 and table.rows[0] == ["a", "0.1235", "–", "–"]
    read = list(csv.DictReader(io.StringIO(csv_of(records))))
    assert read[1] == {"name": "b, c", "value": "", "other": "", "more": "3"}
