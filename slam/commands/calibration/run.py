"""A calibration from start to end: images in, ``camera.yaml`` and a picture of the fit out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from erfsfm.common.errors import DataError
from erfsfm.common.files import require_figure
from erfsfm.common.progress import Progress
from erfsfm.common.readers.camera_file import CameraFile, read_camera_file
from erfsfm.common.readers.images import image_folder, list_images
from erfsfm.common.readers.numbering import in_order
from erfsfm.common.readers.video import VideoFrames
from slam.commands.calibration.board import Board
from slam.commands.calibration.picture import write_picture
from slam.commands.calibration.solve import Calibration, Model, calibrate
from slam.commands.calibration.views import chosen, find_views
from slam.runtime.errors import CalibrationError, sequence_errors
from slam.runtime.storage.files import write_atomically
from slam.sequences.camera_file import DEFAULT_FPS
from slam.sequences.images import ImageFiles, ImageSource
from slam.sequences.undistortion import Undistortion

_MARK = "erfsfm-slam calibrate"  # of a camera file that was calibrated


@dataclass(frozen=True)
class CalibrationFiles:
    """The files that a calibration wrote, and the fit."""

    fit: Calibration
    camera: CameraFile
    camera_file: Path
    picture: Path


@sequence_errors()
def calibrate_camera(
    recording: Path, board: Board, model: Model, output: Path, fps: float | None, progress: Progress
) -> CalibrationFiles:
    """Calibrate a camera from a video or a folder of images of a board.

    Args:
        recording: a video, or a folder of images of one size.
        board: the board.
        model: of the lens.
        output: the ``camera.yaml`` to write; the picture is written beside it, as ``camera.png``, or among
            images, where it would be one of them, as ``camera.pdf``.
        fps: to write; None for the rate of the video, or 10.
        progress: called with (stage, done, total).

    Raises:
        CalibrationError: the images do not give a camera; nothing is written.
        SequenceError: the images cannot be read.
    """
    if output.suffix not in (".yaml", ".yml"):
        raise CalibrationError(f"--output {output} must end in .yaml: it is the camera file that run reads")
    picture = output.with_suffix(".pdf" if _among_images(output) else ".png")
    _refuse_other_kind(output, picture)
    require_figure(picture)
    images, own_fps = _open(recording)
    views = chosen(find_views(images, board, progress))
    fit = calibrate(views, images.width, images.height, model)
    source = f"{_MARK}: {len(fit.views)} views of a {board.describe()}, reprojection error {fit.error_px:.3f} pixels"
    camera = CameraFile(
        width=fit.width,
        height=fit.height,
        fx=_rounded(fit.K[0, 0]),
        fy=_rounded(fit.K[1, 1]),
        cx=_rounded(fit.K[0, 2]),
        cy=_rounded(fit.K[1, 2]),
        fps=fps or _rounded(own_fps or DEFAULT_FPS),
        camera_height_m="unknown",
        model=model,
        distortion=tuple(_rounded(value) for value in fit.distortion),
        source=source,
    )
    Undistortion(camera)  # refuses a lens that cannot be undistorted
    text = yaml.safe_dump(camera.model_dump(mode="json"), sort_keys=False, width=1000)
    write_atomically(output, lambda path: path.write_text(text, encoding="utf-8"), CalibrationError)
    write_picture(picture, fit, camera, images)
    return CalibrationFiles(fit, camera, output, picture)


def _refuse_other_kind(output: Path, picture: Path) -> None:
    """A picture is replaced beside a camera file that was calibrated."""
    if output.is_dir():
        raise CalibrationError(f"--output {output} is a folder: give the name of a file to write")
    source = None
    if output.is_file() and output.stat().st_size:
        try:
            source = read_camera_file(output).source
        except DataError as error:
            raise CalibrationError(f"{output} exists and is no camera file: choose another --output") from error
    if picture.exists() and not (source or "").startswith(_MARK):
        raise CalibrationError(f"{picture} exists and is of no earlier calibration: choose another --output")


def _among_images(output: Path) -> bool:
    """Whether the folder of the output holds images, other than a picture of an earlier calibration."""
    return any(path.stem != output.stem for path in list_images(output.parent))


def _open(recording: Path) -> tuple[ImageSource, float | None]:
    """The images, and their rate where they are a video."""
    if not recording.exists():
        raise DataError(f"no video or folder at {recording}: check the path")
    if recording.is_file():
        video = VideoFrames(recording)
        return video, video.fps
    folder = image_folder(recording)
    if folder is None:
        raise DataError(f"no images in {recording}: give a folder of png, jpg or bmp images, or a video")
    return ImageFiles(in_order(list_images(folder))), None


def _rounded(value: float) -> float:
    """Six digits: far below what a calibration determines."""
    return float(np.format_float_positional(value, precision=6, fractional=False))
