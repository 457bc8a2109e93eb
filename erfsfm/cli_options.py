"""Options and output that several commands of ``erfsfm`` share."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

import typer

from erfsfm.common.table import table_of

Device = Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="where to compute")]
Seed = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="seed of the random numbers")]
UnusedSeed = Annotated[int, typer.Option("--seed", hidden=True, help="accepted for old scripts; nothing is random")]
Weights = Annotated[str, typer.Option(help="a shipped name (default, sim) or a training output folder")]
Json = Annotated[bool, typer.Option("--json", help="print JSON instead of a table")]
Fidelity = Annotated[Literal["default", "paper"], typer.Option(help="paper: exactly as the reference code")]


def print_rows(rows: list[dict[str, Any]], as_json: bool) -> None:
    """A table with a row a line and the keys as its head; or JSON."""
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        table_of(rows).print()
