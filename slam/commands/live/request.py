"""The inputs of a live run, which are the options of the verb ``live``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from slam.commands.options import Config, Device, Output, Overrides, Seed, Weights
from slam.runtime.errors import RunError


@dataclass(frozen=True)
class LiveRequest:
    """All inputs of a live run; ``command`` is recorded in the metrics."""

    camera: Annotated[
        str | None, typer.Option(help="the calibration, as in run; without --dataset the source itself")
    ] = None
    dataset: Annotated[str | None, typer.Option(help="number of a camera, address of a stream, video, or folder")] = (
        None
    )
    calibration: Annotated[
        Path | None, typer.Option(help="camera.yaml or fov=DEGREES; default: beside the folder or video")
    ] = None
    every_frame: Annotated[
        bool, typer.Option("--every-frame", help="wait for each image of a folder or video; drop none")
    ] = False
    output: Output = None
    view: Annotated[bool, typer.Option("--view", help="open the rerun viewer (extra)")] = False
    wait: Annotated[float, typer.Option(min=0.1, max=1e6, help="seconds without an image that end the stream")] = 10.0
    weights: Weights = "default"
    config: Config = None
    overrides: Overrides = None
    seed: Seed = 0
    device: Device = "auto"
    command: str = "slam.commands.live.run.run_live"

    @property
    def source(self) -> str:
        """Where images come from.

        Raises:
            RunError: nothing names it.
        """
        source = self.dataset or self.camera
        if source is None:
            raise RunError(
                "name where images come from: --dataset 0 for the first camera, or an address, video, folder"
            )
        return source

    @property
    def camera_file(self) -> Path | None:
        """The calibration that is given."""
        if self.calibration is not None or self.dataset is None or self.camera is None:
            return self.calibration
        return Path(self.camera)
