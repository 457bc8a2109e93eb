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
    what: Annotated[str, typer.Option(help="mesh, cloud, trajectory, graph, colmap, nerfstudio, raster or occupancy")],
    output: Annotated[Path, typer.Option(help="the file to write; for colmap, nerfstudio and raster a folder")],
    up: Annotated[str, typer.Option(help="axes of the world: y-down (camera axes), z or y-up")] = "y-down",
    crop: Annotated[
        str | None, typer.Option(help="x0,x1,y0,y1,z0,z1 in the axes and unit of the run: the part of the map to keep")
    ] = None,
    voxel: Annotated[float | None, typer.Option(help="one point a cube of this side; a mesh is resampled")] = None,
    triangles: Annotated[int | None, typer.Option(help="simplify the mesh to so many")] = None,
    resolution: Annotated[
        float | None, typer.Option(help="side of a cell of a raster or an occupancy grid; default 0.1")
    ] = None,
    origin: Annotated[
        str | None, typer.Option(help="LAT,LON,HEADING of the first camera, degrees: a raster also as GeoTIFF")
    ] = None,
    dataset: Annotated[
        Path | None, typer.Option(help="where the images of the run are now, for colmap and nerfstudio")
    ] = None,
    points: Annotated[int | None, typer.Option(help="at most so many points of a COLMAP model")] = None,
    seed: UnusedSeed = 0,
    device: UnusedDevice = "auto",
) -> None:
    """Parts of a run as files for other programs.

    The mesh as PLY or glTF, the cloud as PLY, LAS or LAZ (by the end of the name), the trajectory as KITTI or TUM,
    the graph as g2o, the run as a COLMAP model or as a nerfstudio scene (transforms.json and images), the map from
    above as a raster of heights and colours, or as an occupancy grid for ROS.

    Example: erfsfm-slam export results/latest --what mesh --output map.ply --up z
    """
    from slam.commands.exports.export import export as export_run
    from slam.commands.exports.options import ExportOptions, parse_crop, parse_origin
    from slam.results.folder import RunFolder

    options = ExportOptions(parse_crop(crop), voxel, triangles, resolution, parse_origin(origin), dataset, points)
    folder = RunFolder.open(run)
    with progress_bar() as progress:
        progress(f"export of {what}", 0, 1)
        written = export_run(folder, what, output, up, options, progress)
        progress(f"export of {what}", 1, 1)
    typer.echo(f"{what} of {run} in {written}")
    for note in folder.metrics().unit_notes():
        typer.echo(note)
