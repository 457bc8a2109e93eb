"""Tables on standard output."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.table import Table

_IN_A_PIPE = 400
_NAME_WIDTH = 16  # a longer name above a column is folded


@dataclass(frozen=True)
class TerminalTable:
    """Rows of texts under their headers, for rich's console; no text is ever cut.

    Where a row is wider than the terminal the table is turned, with as many of its rows beside each other as fit.

    Attributes:
        head: of every column, lines separated by a line break.
        rows: a text for each column.
        title: above the table.
        notes: lines below it.
        names: how many of the first columns name the row.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    notes: Sequence[str] = ()
    names: int = 1

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        from rich.text import Text

        if self.title:
            yield Text(self.title, "table.title")
        yield from self._fitting(console)
        if self.notes:
            yield Text("\n".join(self.notes), "table.caption")

    def _fitting(self, console: Console) -> Iterator[Table]:
        whole = self._upright()
        if _fits(whole, console):
            yield whole
            return
        rest = list(self.rows)
        while rest:
            count = next((k for k in range(len(rest), 1, -1) if _fits(self._turned(rest[:k]), console)), 1)
            yield self._turned(rest[:count])
            del rest[:count]

    def _upright(self) -> Table:
        table = _empty_table()
        for column, header in enumerate(self.head):
            table.add_column(header, justify="left" if column < self.names else "right", no_wrap=True)
        for row in self.rows:
            table.add_row(*map(_marked, row))
        return table

    def _turned(self, rows: Sequence[Sequence[str]]) -> Table:
        table = _empty_table()
        table.add_column("", no_wrap=True)
        for row in rows:
            name = "\n".join(filter(None, row[: self.names]))
            longest = max(map(len, row[self.names :]), default=1)
            width = max(longest, min(max(map(len, name.split("\n"))), _NAME_WIDTH))
            table.add_column(_marked(name), justify="right", overflow="fold", width=width)
        for column in range(self.names, len(self.head)):
            table.add_row(self.head[column].replace("\n", " "), *(_marked(row[column]) for row in rows))
        return table


def print_table(table: TerminalTable) -> None:
    """As wide as the terminal; upright in a pipe, where other programs read it."""
    from rich.console import Console

    on_terminal = sys.stdout is not None and sys.stdout.isatty()
    Console(width=None if on_terminal else _IN_A_PIPE).print(table)


def _empty_table() -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    return Table(pad_edge=False, box=SIMPLE_HEAD)


def _fits(table: Table, console: Console) -> bool:
    from rich.measure import Measurement

    unlimited = console.options.update(max_width=100_000)
    return Measurement.get(console, unlimited, table).maximum <= console.width


def _marked(text: str) -> RenderableType:
    """A text as it is, with words of warning in red."""
    from rich.text import Text

    marked = Text(text)
    marked.highlight_words(("LEAK", "failed", "did not end"), "bold red")
    return marked
