"""A scene for NeRF and Gaussian splatting: undistorted images, their poses, the cloud of the map."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from erfsfm.common.errors import ErfsfmError
from erfsfm.common.progress import Progress
from slam.commands.exports.raster import write_png
from slam.formats.ply import Ply, write_ply
from slam.formats.trajectory import Trajectory, nearest_stamps
from slam.formats.transforms import TRANSFORMS, write_transforms
from slam.frames import Sequence
from slam.geometry.se3 import FloatArray
from slam.loops.places import Places
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError, SlamError
from slam.runtime.run_files import PLACES
from slam.runtime.storage.files import remove
from slam.runtime.storage.record import Missing, known
from slam.sequences.camera_file import is_field_of_view
from slam.sequences.catalogue import open_sequence
from slam.sequences.excerpt import frame_range

logger = logging.getLogger(__name__)

POINTS = "points.ply"
_IMAGE = re.compile(r"\d{6,}\.png")
_SAME_STAMP_S = 2e-3
_SAME_PIXEL = 0.01


def write_scene(
    folder: RunFolder,
    output: Path,
    trajectory: Trajectory,
    cloud: Ply | None,
    dataset: Path | None,
    progress: Progress,
) -> None:
    """Write ``images/``, ``points.ply`` and, last, ``transforms.json``.

    Frames without a usable image are left out.

    Args:
        folder: the run.
        output: made where missing; images and points of a scene before go, files of other names stay.
        trajectory: optimised, in the axes of the scene.
        cloud: of the map, in the same axes.
        dataset: where the images are now; None where the run found them.
        progress: called with (stage, done, total).

    Raises:
        SlamError: the images are not there or are others, or a file cannot be written.
    """
    sequence, rows = _recording(folder, trajectory, dataset)
    poses: dict[str, FloatArray] = {}
    left_out = interpolated(folder)
    for k, row in enumerate(rows):
        progress("images", k + 1, len(rows))
        if row is None or k in left_out:
            continue
        try:
            image = sequence.frame(row).image
        except (SlamError, ErfsfmError):
            continue
        name = f"images/{k:06d}.png"
        write_png(output / name, np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), np.uint8))
        poses[name] = trajectory.T_world_camera[k]
    if not poses:
        raise RunError(f"no image of {folder.path} can be read: check the data set")
    if len(poses) < len(trajectory):
        logger.warning("%d of %d frames have no usable image: left out", len(trajectory) - len(poses), len(trajectory))
    for path in (output / "images").glob("*.png"):
        if _IMAGE.fullmatch(path.name) and f"images/{path.name}" not in poses:
            remove(path, RunError)
    if cloud is None:
        remove(output / POINTS, RunError)
    else:
        write_ply(output / POINTS, cloud)
    write_transforms(output / TRANSFORMS, sequence.intrinsics, poses, None if cloud is None else POINTS)


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
    """Frames by their stamps; by their order where the recording continues another and its stamps were shifted."""
    metrics, stamps = folder.metrics(), np.asarray(sequence.stamps)
    first = known(metrics.sequence.continued_at)
    if first:
        named = known(metrics.provenance.recording.frames)
        start, stop = frame_range(named or ":", len(stamps))
        added = trajectory.stamps[first:]
        last = stamps[start:stop][-len(added) :]
        if len(last) != len(added) or np.abs(last - added).max() >= _SAME_STAMP_S:
            if stop - start != len(added):
                raise RunError(
                    f"{sequence.name} has {stop - start} frames, but {folder.path} goes on with {len(added)} at frame "
                    f"{first}: give the data set of its last part, as it was"
                )
            return [None] * first + list(range(start, stop))
    nearest = nearest_stamps(trajectory.stamps, stamps)
    same = np.abs(stamps[nearest] - trajectory.stamps) < _SAME_STAMP_S
    if not same.any():
        raise RunError(f"{sequence.name} has no frame at the times of {folder.path}: give the data set of the run")
    return [row if found else None for row, found in zip(nearest.tolist(), same, strict=True)]


def _given(folder: RunFolder, dataset: Path | None) -> dict[str, Any]:
    """Arguments of `open_sequence`, as recorded by the run."""
    recorded = folder.metrics().provenance.recording
    if isinstance(recorded, Missing) and dataset is None:
        raise RunError(f"{folder.path} does not record where its images are: give --dataset ROOT")
    camera = None if isinstance(recorded.camera, Missing) else Path(recorded.camera)
    if dataset is None:
        place = None if isinstance(recorded.dataset, Missing) else Path(recorded.dataset)
    else:
        place = dataset
        if camera is not None and not (camera.exists() or is_field_of_view(camera)):
            camera = None  # it may have moved with the images
    return {"dataset": place, "name": known(recorded.sequence), "camera": camera}


def interpolated(folder: RunFolder) -> set[int]:
    """Frames of a run without a usable image."""
    return {k for gap in folder.metrics().sequence.bridged for k in range(gap.first, gap.last + 1)}
