"""A camera from images of a board: ``camera.yaml``, and a picture of the fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from erfsfm.common.config_tree import dump_yaml
from erfsfm.common.files import refuse_foreign, require_figure, save_figure
from erfsfm.common.progress import Progress
from erfsfm.common.readers.camera_file import CameraFile
from erfsfm.common.readers.images import images_at, list_images
from erfsfm.common.readers.numbering import in_order
from erfsfm.common.readers.video import VideoFrames
from slam.runtime.errors import SlamError, sequence_errors
from slam.runtime.files import write_atomically
from slam.sequences.calibration import (
    Board,
    Calibration,
    Model,
    chosen_views,
    find_views,
    fit_camera,
)
from slam.sequences.camera_file import DEFAULT_FPS, Undistortion, pinhole_keys
from slam.sequences.images import ImageFiles, ImageSource

_WELL_COVERED = 0.6
_SIZE_INCHES, _DPI = (13.0, 5.0), 100
_ARROW_LENGTH = 0.05  # of the image's width, of an error as large as the root mean square


@sequence_errors()
def calibrate_camera(
    recording: Path, board: Board, model: Model, output: Path, fps: float | None, progress: Progress
) -> list[str]:
    """Calibrate a camera from a video or a folder of images of a board; what was found, in lines for the user.

    A picture of the fit is written beside ``output``, ``camera.yaml``: ``camera.png``, or among other images, where it
    would be one of them, ``camera.pdf``. Without ``fps`` the rate of the video is written, or 10.

    Raises:
        SlamError: the images do not give a camera; nothing is written.
        SequenceError: the images cannot be read.
    """
    if output.suffix not in (".yaml", ".yml"):
        raise SlamError(
            f"--output {output} must end in .yaml: it is the camera file that run reads"
        )
    among_images = any(path.stem != output.stem for path in list_images(output.parent))
    picture = output.with_suffix(".pdf" if among_images else ".png")
    refuse_foreign([output], "fx:", SlamError)  # any camera file may be calibrated again
    require_figure(picture)
    images, own_fps = _open(recording)
    views = chosen_views(find_views(images, board, progress))
    fit = fit_camera(views, images.width, images.height, model)
    source = f"erfsfm-slam calibrate: {len(fit.views)} views of a {board.describe()}, "
    source += f"reprojection error {fit.error_px:.3f} pixels"
    focal_and_centre = map(_rounded, fit.K[[0, 1, 0, 1], [0, 1, 2, 2]])
    camera = CameraFile(
        **pinhole_keys(fit.width, fit.height, *focal_and_centre),
        fps=fps or _rounded(own_fps or DEFAULT_FPS),
        camera_height_m="unknown",
        model=model,
        distortion=tuple(_rounded(value) for value in fit.distortion),
        source=source,
    )
    Undistortion(camera)  # refuses a lens that cannot be undistorted
    write_atomically(output, dump_yaml(camera))
    _write_picture(picture, fit, camera, images)
    lines = [
        f"fx {camera.fx:g}, fy {camera.fy:g} ± {100 * fit.focal_sigma:.2f} %, cx {camera.cx:g}, cy {camera.cy:g}, "
        f"{model} {list(camera.distortion)}",
        f"{len(fit.views)} views, tilts to {fit.tilts_deg.max():.0f} degrees, {100 * fit.covered:.0f} % of the image; "
        f"reprojection error {fit.error_px:.3f} pixels, worst view {fit.errors_px.max():.3f}",
    ]
    if fit.covered < _WELL_COVERED:
        lines.append(
            "corners fill little of the image: show the board at its borders, where the lens is less certain"
        )
    if fps is None and recording.is_dir():
        lines.append(
            f"fps {camera.fps:g} is assumed: images have no rate; give --fps, or correct it in the file"
        )
    return [*lines, f"camera in {output}, its fit drawn in {picture}"]


def _write_picture(path: Path, fit: Calibration, camera: CameraFile, images: ImageSource) -> None:
    """Draw a fit: the sharpest image with all corners and the residuals of its own, and the image undistorted."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE_INCHES, dpi=_DPI, layout="constrained")
    before, after = figure.subplots(1, 2)
    view = int(np.argmax([each.sharpness for each in fit.views]))
    image = images.read(fit.views[view].frame)
    longer = _ARROW_LENGTH * fit.width / max(fit.error_px, 1e-9)
    before.imshow(image)
    before.plot(
        *np.concatenate([each.pixels for each in fit.views]).T, ".", color="#e69f00", markersize=2
    )
    u, v = fit.views[view].pixels.T
    du, dv = longer * fit.residuals[view].T
    before.quiver(
        u, v, du, dv, angles="xy", scale_units="xy", scale=1.0, color="#d55e00", width=0.003
    )
    before.set_title(
        f"corners of {len(fit.views)} views; residuals of image {fit.views[view].frame}, {longer:.0f} times"
    )
    after.imshow(Undistortion(camera).apply(image) if camera.is_distorted else image)
    after.set_title(
        f"image {fit.views[view].frame} undistorted: edges of the board must be straight"
    )
    for axis in (before, after):
        axis.set_axis_off()
    save_figure(figure, path, _DPI)


def _open(recording: Path) -> tuple[ImageSource, float | None]:
    """The images, and their rate where they are a video."""
    if recording.is_file():
        video = VideoFrames(recording)
        return video, video.fps
    return ImageFiles(in_order(images_at(recording))), None


def _rounded(value: float) -> float:
    """Six digits: far below what a calibration determines."""
    return float(np.format_float_positional(value, precision=6, fractional=False))
