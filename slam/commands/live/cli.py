"""The verb ``live`` of the command line."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

verbs = typer.Typer()


@verbs.command()
def live(
    camera: Annotated[str, typer.Option(help="number of a camera, address of a stream, pipe, video, or folder")],
    calibration: Annotated[
        Path | None, typer.Option(help="camera.yaml or fov=DEGREES; default: beside the folder or video")
    ] = None,
    output: Annotated[Path | None, typer.Option(help="the run folder; else results/<stamp>_<name>")] = None,
    publish: Annotated[str | None, typer.Option(help="also over ZeroMQ, e.g. tcp://127.0.0.1:5555 (extra)")] = None,
    view: Annotated[bool, typer.Option("--view", help="open the rerun viewer (extra)")] = False,
    wait: Annotated[float, typer.Option(min=0.1, max=1e6, help="seconds without an image that end the stream")] = 10.0,
    weights: Annotated[str, typer.Option(help="as for run")] = "default",
    config: Annotated[str | None, typer.Option(help="as for run")] = None,
    overrides: Annotated[list[str] | None, typer.Option("--set", help="section.key=value; repeat")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="seed of every random draw")] = 0,
    device: Annotated[str, typer.Option(help="where the networks run: auto, cpu or cuda")] = "auto",
) -> None:
    """Poses while frames arrive, one JSON line a frame. Ctrl-C, or the end of the stream, leaves a whole run folder.

    Example: erfsfm-slam live --camera 0 --calibration camera.yaml --output walk
    """
    from slam.commands.live.messages import emitters
    from slam.commands.live.run import LiveRequest, run_live

    with emitters(sys.stdout, publish) as emit:
        folder = run_live(
            LiveRequest(
                camera,
                calibration,
                weights,
                config,
                tuple(overrides or ()),
                output,
                seed,
                device,
                command=shlex.join(["erfsfm-slam", *sys.argv[1:]]),
                wait_s=wait,
                view=view,
            ),
            emit,
        )
    typer.echo(f"everything in {folder.path}", err=True)
