"""Hidden options of verbs that once offered them without effect."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

UnusedDevice = Annotated[Literal["auto", "cpu", "cuda"], typer.Option("--device", hidden=True)]
UnusedSeed = Annotated[int, typer.Option("--seed", hidden=True)]
