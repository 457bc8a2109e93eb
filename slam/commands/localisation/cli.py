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
    truth: Annotated[
        Path | None,
        typer.Option(help="KITTI or TUM poses, a row an image, of the run's file or in the world of its first camera"),
    ] = None,
    output: Annotated[Path | None, typer.Option(help="TUM file for the poses found; image numbers as stamps")] = None,
    as_json: Json = False,
    seed: UnusedSeed = 0,
    device: UnusedDevice = "auto",
) -> None:
    """Poses of new images in an earlier run's map. They are in its frame and unit. With --truth also their errors.

    Example: erfsfm-slam localize photos --map results/latest --output photos.tum
    """
    from slam.commands.localisation.accuracy import MapTruth, summary, summary_line, true_poses
    from slam.commands.localisation.localiser import image_numbers, localise
    from slam.commands.localisation.tables import localisation_json, localisation_table, write_localisations
    from slam.results.folder import RunFolder
    from slam.results.output_file import check_replaced_trajectory
    from slam.runtime.errors import RunError

    run_folder = RunFolder.open(map)
    if output is not None:
        check_replaced_trajectory(output)
        if truth is not None and output.resolve() == truth.resolve():
            raise RunError(f"--output {output} is the file of --truth: choose another --output")
    numbers = image_numbers(images, frames, every)
    known = None
    if truth is not None:
        of_map = MapTruth.of(run_folder)
        known = of_map, true_poses(truth, images, numbers, of_map.T_true_camera)
    with progress_bar() as progress:
        found = []
        for localisation in localise(images, run_folder, camera, numbers):
            found.append(localisation)
            progress("images", len(found), len(numbers))
    errors = None if known is None else [known[0].error(*pair) for pair in zip(found, known[1], strict=True)]
    if output is not None:
        write_localisations(output, found, numbers)
    if as_json:
        typer.echo(json.dumps(localisation_json(found, errors), indent=2))
    else:
        print_table(localisation_table(found, errors))
        for note in run_folder.metrics().unit_notes():
            typer.echo(note)
        if errors is not None:
            typer.echo(summary_line(summary(errors)))
