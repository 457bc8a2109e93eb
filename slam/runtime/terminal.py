"""Tables on standard output."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table


def print_table(table: Table) -> None:
    """As wide as the terminal; in a pipe without wrapping."""
    from rich.console import Console

    on_terminal = sys.stdout is not None and sys.stdout.isatty()
    Console(width=None if on_terminal else 200).print(table)
