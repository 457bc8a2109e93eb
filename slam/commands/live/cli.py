"""The verb ``live`` of the command line."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from functools import partial

import typer

from slam.commands.live.request import LiveRequest
from slam.commands.options import options_of

verbs = typer.Typer()


@verbs.command()
@options_of(LiveRequest)
def live(request: LiveRequest) -> None:
    """Poses while frames arrive, one JSON line a frame. Ctrl-C, or the end of the stream, leaves a whole run folder.

    Example: erfsfm-slam live --dataset 0 --camera camera.yaml --output walk
    """
    from slam.commands.live.run import run_live, write_line

    command = shlex.join(["erfsfm-slam", *sys.argv[1:]])
    folder = run_live(replace(request, command=command), partial(write_line, sys.stdout))
    typer.echo(f"everything in {folder.path}", err=True)
