"""The verb ``export`` of the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from erfsfm.common.progress import progress_bar
from slam.commands.options import UnusedDevice, UnusedSeed

verbs = typer.Typer()


@verbs.command()
def export(
    run: Annotated[Path, typer.Argument(help="a run folder")],
    what: Annotated[str, typer.Option(help="mesh, cloud, colmap, nerfstudio or occupancy")],
    output: Annotated[Path, typer.Option(help="the file to write; for colmap and nerfstudio a folder")],
    up: Annotated[str, typer.Option(help="axes of the world: y-down (camera axes) or z")] = "y-down",
    resolution: Annotated[float | None, typer.Option(help="side of a cell of an occupancy grid; default 0.1")] = None,
    dataset: Annotated[
        Path | None, typer.Option(help="where the images of the run are now, for colmap and nerfstudio")
    ] = None,
    points: Annotated[int | None, typer.Option(help="at most so many points of a COLMAP model")] = None,
    seed: UnusedSeed = 0,
    device: UnusedDevice = "auto",
) -> None:
    """Parts of a run as files for other programs.

    The mesh or the cloud as PLY, the run as a COLMAP model or as a nerfstudio scene (transforms.json and images), or
    the map as an occupancy grid for ROS.

    Example: erfsfm-slam export results/latest --what mesh --output map.ply --up z
    """
    from slam.commands.exports.export import export as export_run
    from slam.results.folder import RunFolder

    folder = RunFolder.open(run)
    with progress_bar() as progress:
        progress(f"export of {what}", 0, 1)
        written = export_run(
            folder, what, output, up, resolution=resolution, dataset=dataset, points=points, progress=progress
        )
        progress(f"export of {what}", 1, 1)
    typer.echo(f"{what} of {run} in {written}")
    for note in folder.metrics().unit_notes():
        typer.echo(note)
