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
    data_set: Annotated[Literal["kitti-odometry"], typer.Argument(help="the data set")],
    sequence: Annotated[str, typer.Option("--sequence", "-s", help="such as 09")],
    to: Annotated[Path, typer.Option(help="folder that gets it")],
    camera: Annotated[Literal["colour", "grey"], typer.Option(help="which images")] = "colour",
    lidar: Annotated[bool, typer.Option("--lidar", help="scans as well")] = False,
    accept_licence: Annotated[
        bool, typer.Option("--accept-licence", help="you accept the licence that is shown")
    ] = False,
    mirror: Annotated[str | None, typer.Option(help="address of the archives, in place of the official one")] = None,
) -> None:
    """One sequence of KITTI odometry from its official server.

    Of its archives only the files of the sequence are fetched. Run again, an interrupted download goes on.

    Example: erfsfm-slam download kitti-odometry --sequence 09 --to KITTI
    """
    from slam.commands.downloads import kitti

    typer.echo(kitti.LICENCE)
    if not accept_licence:
        if not sys.stdin.isatty():
            raise DownloadError("the licence above is to be accepted: give --accept-licence")
        if not typer.confirm("Do you accept it?"):
            raise DownloadError("the licence was not accepted: nothing is downloaded")
    with progress_bar() as progress:
        count = kitti.download_kitti(sequence, to, mirror or kitti.SERVER, camera == "grey", lidar, progress)
    typer.echo(f"{count} files in {to}: erfsfm-slam run --dataset {to} --sequence {sequence}")
