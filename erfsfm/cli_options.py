"""Options and output that several commands of ``erfsfm`` share."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

import typer

Device = Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="where to compute")]
Seed = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="seed of the random numbers")]
UnusedSeed = Annotated[int, typer.Option("--seed", hidden=True, help="accepted for old scripts; nothing is random")]
Weights = Annotated[str, typer.Option(help="a shipped name (default, sim) or a training output folder")]
Json = Annotated[bool, typer.Option("--json", help="print JSON instead of a table")]
Fidelity = Annotated[Literal["default", "paper"], typer.Option(help="paper: exactly as the reference code")]


def print_rows(rows: list[dict[str, Any]], as_json: bool) -> None:
    """A row a line, or JSON."""
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
        return
    for row in rows:
        typer.echo("  ".join(f"{k} {v:.4f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
