"""The verb ``calibrate`` of the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from erfsfm.common.progress import progress_bar
from slam.commands.options import UnusedDevice, UnusedSeed

verbs = typer.Typer()


@verbs.command()
def calibrate(
    recording: Annotated[Path, typer.Argument(help="a video or a folder of images of the board")],
    board: Annotated[str, typer.Option(help="corners between the squares: 9x6 for 10 by 7 squares")],
    output: Annotated[Path, typer.Option(help="the camera.yaml to write")] = Path("camera.yaml"),
    square_m: Annotated[float, typer.Option(min=1e-4, max=10.0, help="side of a square in metres")] = 0.03,
    model: Annotated[Literal["opencv", "fisheye"], typer.Option(help="lens; fisheye beyond 110 degrees")] = "opencv",
    pattern: Annotated[Literal["chessboard", "charuco"], typer.Option(help="pattern of the board")] = "chessboard",
    dictionary: Annotated[str, typer.Option(help="OpenCV's dictionary of the ArUco markers")] = "5X5_100",
    marker_share: Annotated[
        float, typer.Option(min=0.1, max=0.99, help="side of a marker over that of a square")
    ] = 0.75,
    fps: Annotated[
        float | None, typer.Option(min=1e-3, max=1e4, help="frame rate to write; default: the video's, or 10")
    ] = None,
    seed: UnusedSeed = 0,
    device: UnusedDevice = "auto",
) -> None:
    """A camera.yaml from images of a chessboard or a ChArUco board.

    Images are chosen for spread and sharpness. The fit is drawn beside the output. Nothing is written where the images
    do not determine the camera.

    Example: erfsfm-slam calibrate board.mp4 --board 9x6 --square-m 0.03 --output camera.yaml
    """
    from slam.commands.calibration.board import Board, parse_board
    from slam.commands.calibration.run import calibrate_camera
    from slam.commands.calibration.solve import WELL_COVERED

    wanted = Board(*parse_board(board), square_m, pattern, dictionary, marker_share)
    with progress_bar() as progress:
        files = calibrate_camera(recording, wanted, model, output, fps, progress)
    fit, camera = files.fit, files.camera
    focal = f"fx {camera.fx:g}, fy {camera.fy:g} ± {100 * fit.focal_sigma:.2f} %"
    typer.echo(f"{focal}, cx {camera.cx:g}, cy {camera.cy:g}, {model} {list(camera.distortion)}")
    typer.echo(
        f"{len(fit.views)} views, tilts to {fit.tilts_deg.max():.0f} degrees, {100 * fit.covered:.0f} % of the image; "
        f"reprojection error {fit.error_px:.3f} pixels, worst view {fit.errors_px.max():.3f}"
    )
    if fit.covered < WELL_COVERED:
        typer.echo(
            "corners fill little of the image: the lens is less certain at its borders; show the board there, too"
        )
    if fps is None and recording.is_dir():
        typer.echo(f"fps {camera.fps:g} is assumed: images have no rate; give --fps, or correct it in the file")
    typer.echo(f"camera in {files.camera_file}, its fit drawn in {files.picture}")
