"""The inputs of a live run, which are the options of the verb ``live``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from slam.commands.options import Config, Device, Output, Overrides, Seed, Weights


@dataclass(frozen=True)
class LiveRequest:
    """All inputs of a live run; ``command`` is recorded in the metrics."""

    camera: Annotated[str, typer.Option(help="number of a camera, address of a stream, pipe, video, or folder")]
    calibration: Annotated[
        Path | None, typer.Option(help="camera.yaml or fov=DEGREES; default: beside the folder or video")
    ] = None
    output: Output = None
    view: Annotated[bool, typer.Option("--view", help="open the rerun viewer (extra)")] = False
    wait: Annotated[float, typer.Option(min=0.1, max=1e6, help="seconds without an image that end the stream")] = 10.0
    weights: Weights = "default"
    config: Config = None
    overrides: Overrides = None
    seed: Seed = 0
    device: Device = "auto"
    command: str = "slam.commands.live.run.run_live"
