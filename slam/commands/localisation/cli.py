"""The verb ``localize`` of the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from erfsfm.common.progress import progress_bar
from slam.commands.options import Json, UnusedDevice, UnusedSeed
from slam.runtime.terminal import print_table

verbs = typer.Typer()


@verbs.command()
def localize(
    images: Annotated[Path, typer.Argument(help="an image or a folder of images")],
    map: Annotated[Path, typer.Option("--map", help="a run folder")],
    camera: Annotated[
        Path | None,
        typer.Option(
            "--camera", "--calibration", help="camera.yaml or fov=70; default: beside the images, else the run's"
        ),
    ] = None,
    frames: Annotated[str | None, typer.Option(help="A:B of the images, half-open")] = None,
    every: Annotated[int, typer.Option(min=1, help="every n-th of them")] = 1,
    output: Annotated[
        Path | None, typer.Option(help="poses found, as TUM with image numbers as stamps, or .kitti")
    ] = None,
    as_json: Json = False,
    seed: UnusedSeed = 0,
    device: UnusedDevice = "auto",
) -> None:
    """Poses of new images in an earlier run's map. They are in its frame and unit.

    Example: erfsfm-slam localize photos --map results/latest --output photos.tum
    """
    from slam.commands.localisation.localiser import image_numbers, localise
    from slam.commands.localisation.tables import localisation_json, localisation_table, write_localisations
    from slam.results.folder import RunFolder
    from slam.results.output_file import check_replaced_trajectory

    run_folder = RunFolder.open(map)
    if output is not None:
        check_replaced_trajectory(output)
    numbers = image_numbers(images, frames, every)
    with progress_bar() as progress:
        found = []
        for localisation in localise(images, run_folder, camera, numbers):
            found.append(localisation)
            progress("images", len(found), len(numbers))
    if output is not None:
        write_localisations(output, found, numbers)
    if as_json:
        typer.echo(json.dumps(localisation_json(found), indent=2))
    else:
        print_table(localisation_table(found))
        for note in run_folder.metrics().unit_notes():
            typer.echo(note)
