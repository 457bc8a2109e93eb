"""The undistorted images of a run, from where the run or the user found them."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import ErfsfmError
from erfsfm.common.progress import Progress
from slam.formats.trajectory import Trajectory, nearest_stamps
from slam.frames import Intrinsics, Sequence
from slam.loops.places import Places
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError, SlamError
from slam.runtime.run_files import PLACES
from slam.runtime.storage.files import remove, write_atomically
from slam.sequences.camera_file import is_field_of_view
from slam.sequences.catalogue import open_sequence

logger = logging.getLogger(__name__)

FOLDER = "images"
_IMAGE = re.compile(r"\d{6,}\.png")
_SAME_STAMP_S = 2e-3
_SAME_PIXEL = 0.01


def write_images(
    folder: RunFolder, output: Path, trajectory: Trajectory, dataset: Path | None, progress: Progress
) -> tuple[Intrinsics, list[int]]:
    """Write ``images/NNNNNN.png`` of all frames with a usable image; others of such a name go.

    Args:
        folder: the run.
        output: made where missing.
        trajectory: optimised.
        dataset: where the images are now; None where the run found them.
        progress: called with (stage, done, total).

    Returns:
        The camera, and the frames that have an image.

    Raises:
        SlamError: the images are not there or are others, or a file cannot be written.
    """
    sequence, rows = _recording(folder, trajectory, dataset)
    written: list[int] = []
    left_out = interpolated(folder)
    for k, row in enumerate(rows):
        progress("images", k + 1, len(rows))
        if row is None or k in left_out:
            continue
        try:
            image = sequence.frame(row).image
        except (SlamError, ErfsfmError):
            continue
        _write_png(output / image_name(k), image)
        written.append(k)
    if not written:
        raise RunError(f"no image of {folder.path} can be read: check the data set")
    if len(written) < len(trajectory):
        missing = len(trajectory) - len(written)
        logger.warning("%d of %d frames have no usable image: left out", missing, len(trajectory))
    names = {image_name(k) for k in written}
    for path in (output / FOLDER).glob("*.png"):
        if _IMAGE.fullmatch(path.name) and f"{FOLDER}/{path.name}" not in names:
            remove(path, RunError)
    return sequence.intrinsics, written


def _write_png(path: Path, image: NDArray[np.uint8]) -> None:
    done, content = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not done:
        raise RunError(f"{path}: cannot be encoded")
    write_atomically(path, lambda partial: partial.write_bytes(content.tobytes()), RunError)


def image_name(frame: int) -> str:
    """Of the image of a frame, seen from the scene's folder."""
    return f"{FOLDER}/{frame:06d}.png"


def is_recorded(folder: RunFolder) -> bool:
    """Whether a run says where its images are."""
    return not folder.metrics().provenance.recording.absent


def _recording(folder: RunFolder, trajectory: Trajectory, dataset: Path | None) -> tuple[Sequence, list[int | None]]:
    """The recording, and which frame of it each row of the trajectory is."""
    given = _given(folder, dataset)
    try:
        sequence = open_sequence(**given)
    except (SlamError, ErfsfmError) as error:
        raise RunError(
            f"the images of {folder.path} are needed and not found ({error}); give --dataset ROOT"
        ) from error
    camera = Places.read(folder.require(PLACES)).intrinsics
    wanted, found = ((c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (camera, sequence.intrinsics))
    if not np.allclose(wanted, found, atol=_SAME_PIXEL):
        raise RunError(f"{sequence.name} has another camera than {folder.path}: give the data set of the run")
    return sequence, _rows(folder, trajectory, sequence)


def _rows(folder: RunFolder, trajectory: Trajectory, sequence: Sequence) -> list[int | None]:
    """Frames by their stamps."""
    stamps = np.asarray(sequence.stamps)
    nearest = nearest_stamps(trajectory.stamps, stamps)
    same = np.abs(stamps[nearest] - trajectory.stamps) < _SAME_STAMP_S
    if not same.any():
        raise RunError(f"{sequence.name} has no frame at the times of {folder.path}: give the data set of the run")
    return [row if found else None for row, found in zip(nearest.tolist(), same, strict=True)]


def _given(folder: RunFolder, dataset: Path | None) -> dict[str, Any]:
    """Arguments of `open_sequence`, as recorded by the run."""
    recorded = folder.metrics().provenance.recording
    if recorded.absent and dataset is None:
        raise RunError(f"{folder.path} does not record where its images are: give --dataset ROOT")
    camera = None if recorded.camera is None else Path(recorded.camera)
    if dataset is None:
        place = None if recorded.dataset is None else Path(recorded.dataset)
    else:
        place = dataset
        if camera is not None and not (camera.exists() or is_field_of_view(camera)):
            camera = None  # it may have moved with the images
    return {"dataset": place, "name": recorded.sequence, "camera": camera}


def interpolated(folder: RunFolder) -> set[int]:
    """Frames of a run without a usable image."""
    return {k for gap in folder.metrics().sequence.bridged or () for k in range(gap.first, gap.last + 1)}
