"""The verb ``download`` of the command line."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from erfsfm.common.progress import progress_bar
from slam.runtime.errors import DownloadError

verbs = typer.Typer()


@verbs.command()
def download(
    data_set: Annotated[Literal["kitti-odometry", "tum-rgbd"], typer.Argument(help="the data set")],
    sequence: Annotated[str, typer.Option("--sequence", "-s", help="09, or freiburg1_xyz")],
    to: Annotated[Path, typer.Option(help="folder that gets it")],
    camera: Annotated[Literal["colour", "grey"], typer.Option(help="images of KITTI")] = "colour",
    lidar: Annotated[bool, typer.Option("--lidar", help="KITTI's scans as well")] = False,
    accept_licence: Annotated[
        bool, typer.Option("--accept-licence", help="you accept the licence that is shown")
    ] = False,
    mirror: Annotated[str | None, typer.Option(help="address of the archives, in place of the official one")] = None,
) -> None:
    """One sequence of a public data set from its official server.

    Of KITTI's archives only the files of the sequence are fetched. Run again, an interrupted download goes on.

    Example: erfsfm-slam download kitti-odometry --sequence 09 --to KITTI
    """
    from slam.commands.downloads import kitti, tum

    source = kitti if data_set == "kitti-odometry" else tum
    typer.echo(source.LICENCE)
    if not accept_licence:
        if not sys.stdin.isatty():
            raise DownloadError("the licence above is to be accepted: give --accept-licence")
        if not typer.confirm("Do you accept it?"):
            raise DownloadError("the licence was not accepted: nothing is downloaded")
    server = mirror or source.SERVER
    with progress_bar() as progress:
        if source is kitti:
            count = kitti.download_kitti(sequence, to, server, camera == "grey", lidar, progress)
            typer.echo(f"{count} files in {to}: erfsfm-slam run --dataset {to} --sequence {sequence}")
        else:
            folder = tum.download_tum(sequence, to, server, progress)
            typer.echo(f"{folder}: erfsfm-slam run --dataset {folder}")
