"""The inputs of a run: the options of the verb ``run`` and the arguments of `slam.run_slam`, written once."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from erfsfm.common.progress import Progress
from slam.commands.options import LARGEST_SEED, Config, Device, Output, Overrides, Weights
from slam.runtime.errors import RunError
from slam.runtime.storage.files import from_anywhere

if TYPE_CHECKING:
    from slam.results.metrics import Recording

_RECORDING = ("dataset", "camera", "gps", "sequence", "frames", "truth")
_TEXTS = ("weights", "config")  # names, or paths


@dataclass(frozen=True)
class RunRequest:
    """All inputs of a run. Those with a help are options of the command line.

    Without ``dataset`` and ``sequence`` the embedded simulated street is run. From Python, a path may be text.

    Attributes:
        progress: called with (stage, done, total).
        command: recorded in the metrics.
    """

    dataset: Annotated[
        Path | None, typer.Option(help="a data set, image folder or video: docs/recordings.md lists all kinds")
    ] = None
    sequence: Annotated[
        str | None,
        typer.Option("--sequence", "-s", "--topic", help="name inside the data set, e.g. 09; the image topic of a bag"),
    ] = None
    camera: Annotated[
        Path | None,
        typer.Option("--camera", "--calibration", help="camera.yaml, or fov=70: the horizontal field of view, degrees"),
    ] = None
    weights: Weights = "default"
    config: Config = None
    overrides: Overrides = None
    frames: Annotated[str | None, typer.Option(help="A:B, half-open")] = None
    truth: Annotated[Path | None, typer.Option(help="true camera poses: KITTI (a row a frame) or TUM (by stamps)")] = (
        None
    )
    output: Output = None
    rerun: Annotated[Path | None, typer.Option(help="also write an .rrd file for the rerun viewer (extra)")] = None
    gps: Annotated[Path | None, typer.Option(help="GPS track, CSV or NMEA")] = None
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="of every random draw")] = 0
    device: Device = "auto"
    progress: Progress | None = None
    command: str = "slam.run_slam"

    @classmethod
    def of(cls, **arguments: Any) -> RunRequest:
        """The request of arguments given in Python, or read from a file.

        Raises:
            TypeError: an unknown argument.
            RunError: a value of another kind.
        """
        from pydantic import TypeAdapter, ValidationError  # takes as long to import as the rest of the command line

        from erfsfm.common.config_tree import first_problem

        names = [field.name for field in fields(cls)]
        unknown = arguments.keys() - set(names)
        if unknown:
            raise TypeError(f"run_slam has no argument {', '.join(sorted(unknown))}: it has {', '.join(names)}")
        arguments |= {key: str(arguments[key]) for key in _TEXTS if isinstance(arguments.get(key), Path)}
        try:
            request = TypeAdapter(cls).validate_python(arguments)
        except ValidationError as error:
            raise RunError(f"run_slam: {first_problem(error)}") from error
        if not 0 <= request.seed <= LARGEST_SEED:
            raise RunError(f"run_slam: seed: should be from 0 to {LARGEST_SEED}; got {request.seed}")
        return request

    @property
    def recording(self) -> Recording:
        """The options that name the recording, files by their whole paths."""
        from slam.results.metrics import Recording

        given = {name: getattr(self, name) for name in _RECORDING}
        texts = {
            name: from_anywhere(value) if isinstance(value, Path) else value
            for name, value in given.items()
            if value is not None
        }
        return Recording.of(**texts)
