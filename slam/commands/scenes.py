"""A run as a scene for other programs: undistorted images with poses and points, for COLMAP or for nerfstudio."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from erfsfm.common.errors import ErfsfmError
from erfsfm.common.progress import Progress
from slam.formats.colmap import Sightings, write_colmap
from slam.formats.ply import Ply, write_ply
from slam.formats.trajectory import Trajectory, nearest_stamps
from slam.frames import Image, Sequence
from slam.geometry.se3 import FloatArray
from slam.loops.places import Places
from slam.loops.structure import PlaceStructure
from slam.loops.verification import OF_KEYFRAMES
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError, SlamError
from slam.runtime.run_files import PLACES
from slam.runtime.storage.files import write_atomically
from slam.sequences.camera_file import is_field_of_view
from slam.sequences.catalogue import open_sequence

logger = logging.getLogger(__name__)

POINTS, TRANSFORMS = "points.ply", "transforms.json"
_MADE_BY = {"made_by": "erfsfm-slam"}
MARK = json.dumps(_MADE_BY)[1:-1]  # of a ``transforms.json`` of ours
_T_CAMERA_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_HALF_PIXEL = 0.5  # (0.5, 0.5) is the centre of their top-left pixel
_IMAGES = "images"
_SAME_STAMP_S = 2e-3
_SAME_PIXEL = 0.01
_GREY = 128


def write_model(
    folder: RunFolder,
    output: Path,
    trajectory: Trajectory,
    R_up_world: FloatArray,
    cloud: Ply | None,
    dataset: Path | None,
    at_most: int | None,
    progress: Progress,
) -> None:
    """Write ``images/`` and, last, the model of COLMAP: corners tracked through the images, and the cloud of the map.

    Args:
        folder: the run; one that does not record where its images are has none here, with a warning.
        output: made where missing.
        trajectory: optimised, in the axes of the model.
        R_up_world: ``(3, 3)`` from the axes of the run to these.
        cloud: of the map, in these axes.
        dataset: where the images are now; None where the run found them.
        at_most: so many points; None for all.
        progress: called with (stage, done, total).

    Raises:
        SlamError: the images are not there or are others, or a file cannot be written.
    """
    places = Places.read(folder.require(PLACES))
    without = _interpolated(folder)
    if dataset is None and folder.metrics().provenance.recording.absent:
        logger.warning("%s does not record where its images are: the model has none; give --dataset", folder.path)
    else:
        without = set(range(len(trajectory))) - set(_write_images(folder, output, trajectory, dataset, progress)[1])
    points, sightings = _tracked(places, at_most)
    points = points @ R_up_world.T
    colours = np.full((len(points), 3), _GREY, np.uint8)
    if cloud is not None:
        if len(points):
            colours = cloud.colours[cKDTree(cloud.points).query(points)[1]]
        count = len(cloud.points) if at_most is None else min(max(at_most - len(points), 0), len(cloud.points))
        rows = np.linspace(0, len(cloud.points) - 1, count).round().astype(np.intp)
        points = np.concatenate([points, cloud.points[rows]])
        colours = np.concatenate([colours, cloud.colours[rows]])
    write_colmap(output, places.intrinsics, trajectory.T_world_camera, points, colours, sightings, without)


def write_scene(
    folder: RunFolder, output: Path, trajectory: Trajectory, cloud: Ply | None, dataset: Path | None, progress: Progress
) -> None:
    """Write ``images/``, ``points.ply`` and, last, ``transforms.json``, which tools for Gaussian splatting read.

    Its cameras have OpenGL's axes: x right, y up, z backwards. Frames without a usable image are left out. Arguments
    and errors are those of `write_model`.
    """
    sequence, written = _write_images(folder, output, trajectory, dataset, progress)
    camera = sequence.intrinsics
    scene: dict[str, Any] = {
        **_MADE_BY,
        "camera_model": "OPENCV",
        "fl_x": float(camera.fx),
        "fl_y": float(camera.fy),
        "cx": float(camera.cx) + _HALF_PIXEL,
        "cy": float(camera.cy) + _HALF_PIXEL,
        "w": camera.width,
        "h": camera.height,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    }
    if cloud is not None:
        write_ply(output / POINTS, cloud)
        scene["ply_file_path"] = POINTS
    poses = {k: (trajectory.T_world_camera[k] @ _T_CAMERA_OPENGL).tolist() for k in written}
    scene["frames"] = [{"file_path": _image_name(k), "transform_matrix": pose} for k, pose in poses.items()]
    text = json.dumps(scene, indent=2, allow_nan=False) + "\n"
    write_atomically(output / TRANSFORMS, lambda file: file.write_text(text, encoding="utf-8"), RunError)


def _tracked(places: Places, at_most: int | None) -> tuple[FloatArray, Sightings]:
    """Points of corners ``(P, 3)`` in the axes of the run, at most as many as wanted, the longest tracks first."""
    if not places.views:
        return np.zeros((0, 3)), Sightings.none()
    structure = PlaceStructure(places, OF_KEYFRAMES)
    tracks = structure.tracks()
    length = np.bincount(tracks.point, minlength=len(tracks.points))
    wanted = np.isfinite(tracks.points).all(axis=1)
    chosen = np.argsort(np.where(wanted, -length, 1), kind="stable")[: int(wanted.sum())][:at_most]
    number = np.full(len(tracks.points), -1)
    number[chosen] = np.arange(len(chosen))
    kept = number[tracks.point] >= 0
    views, corners = tracks.views[kept], tracks.corners[kept]
    pixels = structure.pixels(views, corners)
    frames = np.array([view.index for view in places.views], np.intp)[views]
    return tracks.points[chosen], Sightings(frames, pixels, number[tracks.point[kept]], tracks.errors_px[kept])


def _write_images(
    folder: RunFolder, output: Path, trajectory: Trajectory, dataset: Path | None, progress: Progress
) -> tuple[Sequence, list[int]]:
    """Write ``images/NNNNNN.png`` of all frames with a usable image, which are returned."""
    sequence, rows = _recording(folder, trajectory, dataset)
    written, without = [], _interpolated(folder)
    for k, row in enumerate(rows):
        progress("images", k + 1, len(rows))
        if row is None or k in without:
            continue
        try:
            image = sequence.frame(row).image
        except (SlamError, ErfsfmError):
            continue
        _write_png(output / _image_name(k), image)
        written.append(k)
    if not written:
        raise RunError(f"no image of {folder.path} can be read: check the data set")
    if len(written) < len(rows):
        logger.warning("%d of %d frames have no usable image: left out", len(rows) - len(written), len(rows))
    return sequence, written


def _write_png(path: Path, image: Image) -> None:
    _, content = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    write_atomically(path, lambda partial: partial.write_bytes(content.tobytes()), RunError)


def _image_name(frame: int) -> str:
    """Of the image of a frame, seen from the scene's folder."""
    return f"{_IMAGES}/{frame:06d}.png"


def _recording(folder: RunFolder, trajectory: Trajectory, dataset: Path | None) -> tuple[Sequence, list[int | None]]:
    """The recording of a run, and which frame of it, by its stamp, each row of the trajectory is."""
    recorded = folder.metrics().provenance.recording
    if recorded.absent and dataset is None:
        raise RunError(f"{folder.path} does not record where its images are: give --dataset ROOT")
    place = dataset or (None if recorded.dataset is None else Path(recorded.dataset))
    camera = None if recorded.camera is None else Path(recorded.camera)
    if dataset is not None and camera is not None and not (camera.exists() or is_field_of_view(camera)):
        camera = None  # it may have moved with the images
    try:
        sequence = open_sequence(place, recorded.sequence, camera)
    except (SlamError, ErfsfmError) as error:
        raise RunError(
            f"the images of {folder.path} are needed and not found ({error}); give --dataset ROOT"
        ) from error
    own = Places.read(folder.require(PLACES)).intrinsics
    expected, found = ((c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (own, sequence.intrinsics))
    if not np.allclose(expected, found, atol=_SAME_PIXEL):
        raise RunError(f"{sequence.name} has another camera than {folder.path}: give the data set of the run")
    stamps = np.asarray(sequence.stamps)
    nearest = nearest_stamps(trajectory.stamps, stamps)
    same = np.abs(stamps[nearest] - trajectory.stamps) < _SAME_STAMP_S
    if not same.any():
        raise RunError(f"{sequence.name} has no frame at the times of {folder.path}: give the data set of the run")
    return sequence, [row if is_same else None for row, is_same in zip(nearest.tolist(), same, strict=True)]


def _interpolated(folder: RunFolder) -> set[int]:
    """Frames of a run without a usable image."""
    return {k for gap in folder.metrics().sequence.bridged or () for k in range(gap.first, gap.last + 1)}
