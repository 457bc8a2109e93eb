"""Tables: rows of texts that are written to a terminal, as CSV, as Markdown or as HTML."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import chain
from typing import Any

DASH = "–"
_IN_A_PIPE = 400  # columns
_WARNINGS = ("LEAK", "failed", "did not end")


@dataclass(frozen=True)
class Table:
    """Rows of texts under their headers.

    Attributes:
        head: of every column, lines separated by a line break; empty for rows of a name and what it means.
        rows: a text for each column.
        title: above the table.
        notes: lines below it.
        names: how many of the first columns name the row; the others are set to the right.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    notes: Sequence[str] = ()
    names: int = 1

    def print(self) -> None:
        """On standard output; where it is wider than the terminal, cells are folded and nothing is cut."""
        from rich.box import SIMPLE_HEAD
        from rich.console import Console
        from rich.table import Table as RichTable
        from rich.text import Text

        on_terminal = sys.stdout is not None and sys.stdout.isatty()
        console = Console(width=None if on_terminal else _IN_A_PIPE)
        table = RichTable(pad_edge=False, box=SIMPLE_HEAD)
        for column, header in enumerate(self.head):
            table.add_column(
                header, justify="left" if column < self.names else "right", overflow="fold"
            )
        for row in self.rows:
            cells = list(map(Text, row))
            for cell in cells:
                cell.highlight_words(_WARNINGS, "bold red")
            table.add_row(*cells)
        if self.title:
            console.print(Text(self.title, "table.title"))
        console.print(table)
        if self.notes:
            console.print(Text("\n".join(self.notes), "table.caption"))

    def markdown(self) -> str:
        """A table of Markdown, without title and notes."""
        rule = "|" + "---|" * self.names + "---:|" * (len(self.head) - self.names)
        head, *rows = (f"| {' | '.join(cells)} |" for cells in (self.head, *self.rows))
        return "\n".join([head.replace("\n", " "), rule, *rows])

    def html(self) -> str:
        """A table of HTML with its title and notes; a cell that has ``__html__`` is HTML already."""
        title = f"<h3>{escape(self.title)}</h3>" if self.title else ""
        head = f"<thead>{_html_row(self.head, 'th')}</thead>" if self.head else ""
        body = "".join(_html_row(row, "td") for row in self.rows)
        table = f'<div class="scroll"><table class="names{self.names}">{head}<tbody>{body}</tbody></table></div>'
        notes = "".join(f'<p class="note">{escape(note)}</p>' for note in self.notes)
        return title + (table if self.rows else "") + notes


def table_of(rows: Sequence[dict[str, Any]]) -> Table:
    """Records as a table whose head are their keys."""
    keys = list(dict.fromkeys(chain.from_iterable(rows)))
    names = 0
    while names < len(keys) and not _has_numbers(rows, keys[names]):
        names += 1
    cells = []
    for row in rows:
        cells.append([_written(row.get(key)) for key in keys])
    return Table(keys, cells, names=names if names < len(keys) else 1)


def _has_numbers(rows: Sequence[dict[str, Any]], key: str) -> bool:
    return any(isinstance(row.get(key), float | int) for row in rows)


def csv_of(rows: Iterable[dict[str, Any]]) -> str:
    """Records as CSV, a header with all keys first; None is empty."""
    records, text = list(rows), io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(chain.from_iterable(records))))
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue()


def _written(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4f}"
    return DASH if value is None else str(value)


def _html_row(cells: Sequence[str], tag: str) -> str:
    row = ""
    for cell in cells:
        text = cell if hasattr(cell, "__html__") else escape(cell).replace("\n", "<br>")
        row += f"<{tag}>{text}</{tag}>"
    return f"<tr>{row}</tr>"
