"""Parts of a run as files for other programs: its map, an occupancy grid, images with poses and points."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from erfsfm.common.errors import OneLineError
from erfsfm.common.files import refuse_foreign
from erfsfm.common.progress import Progress, silent
from erfsfm.common.readers.camera_file import CAMERA_FILE, CameraFile, Pinhole
from slam.formats.colmap import BINARY_FOLDER, HEADER, MODEL_FILES, Sightings, write_colmap
from slam.formats.ply import R_UP_WORLD, Ply, read_ply, rotated, write_ply
from slam.formats.trajectory import Trajectory, nearest_stamps, read_trajectory
from slam.frames import Intrinsics
from slam.geometry import se3
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray
from slam.loops.places import Places, PlaceStructure
from slam.loops.verification import OF_KEYFRAMES
from slam.mapping.occupancy import occupancy_grid, write_ros_map
from slam.results.folder import RunFolder, check_replaced
from slam.results.metrics import CAMERA_HEIGHTS, METRES
from slam.runtime.errors import RunError
from slam.runtime.files import ESTIMATE, MAP_CLOUD, MAP_MESH, MASK, PLACES, write_atomically
from slam.sequences.camera_file import write_camera
from slam.sequences.recording import RecordedSequence
from slam.simulation.recording import open_or_embedded

logger = logging.getLogger(__name__)

R_UP_WORLDS = {"y-down": np.eye(3), "z": R_UP_WORLD}  # from a camera's x right, y down, z ahead
POINTS, TRANSFORMS = "points.ply", "transforms.json"
_IMAGES = "images"
_DRIVE = _IMAGES, CAMERA_FILE, MASK
_MADE_BY = {"made_by": "erfsfm-slam"}
_MAPS = {"mesh": MAP_MESH, "cloud": MAP_CLOUD}
_SUFFIXES = {
    "mesh": (".ply",),
    "cloud": (".ply",),
    "occupancy": (".yaml", ".pgm"),
    "colmap": (),
    "nerfstudio": (),
}
_SCENES = {  # files, and what one of them holds if it is ours
    "colmap": ((*_DRIVE, BINARY_FOLDER, *MODEL_FILES), HEADER),
    "nerfstudio": ((*_DRIVE, POINTS, TRANSFORMS), json.dumps(_MADE_BY)[1:-1]),
}
_T_CAMERA_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_HALF_PIXEL = 0.5  # (0.5, 0.5) is the centre of their top-left pixel
_TAKERS = {"resolution": ("occupancy",), "dataset": tuple(_SCENES), "points": ("colmap",)}
_RESOLUTION = 0.1  # of an occupancy grid
_SAME_STAMP_S = 2e-3
_SAME_PIXEL = 0.01
_GREY = 128


def export(
    folder: RunFolder,
    what: str,
    output: Path,
    up: str = "y-down",
    *,
    resolution: float | None = None,
    dataset: Path | None = None,
    points: int | None = None,
    progress: Progress = silent,
) -> Path:
    """Write one part of a run, each file whole or not at all; missing parent folders are made.

    Args:
        folder: the run.
        what: ``mesh`` or ``cloud`` (PLY), ``colmap`` (a model), ``nerfstudio`` (images and ``transforms.json``) or
            ``occupancy`` (a grid for ROS, always with z up).
        output: the file; for ``colmap`` and ``nerfstudio`` the folder.
        up: ``y-down`` as the run has it; ``z``: x right, y ahead, z up. Cameras keep their own axes, only the world is
            rotated.
        resolution, dataset, points: as ``erfsfm-slam export --help`` explains them.
        progress: is told how many images are written.

    Returns:
        What was written: of an occupancy grid the ``.yaml``.

    Raises:
        SlamError: an option without effect, a part that the run lacks or that is damaged, missing or other images, or a
            file that cannot be written.
    """
    for name, value in {"resolution": resolution, "dataset": dataset, "points": points}.items():
        if value is not None and what not in _TAKERS[name]:
            raise RunError(
                f"--{name} does nothing for {what}: it is for {' and '.join(_TAKERS[name])}"
            )
    _check_target(what, output)
    if what in _MAPS:
        write_ply(output, _map(folder, what, up))
    elif what == "occupancy":
        return _export_occupancy(folder, output, resolution or _RESOLUTION)
    else:
        trajectory = _trajectory(folder, up)
        cloud = _map(folder, "cloud", up) if (folder.path / MAP_CLOUD).is_file() else None
        without = _interpolated(folder)
        has_images = (
            what == "nerfstudio"
            or dataset is not None
            or folder.metrics().provenance.recording is not None
        )
        if has_images:
            camera, written = _write_images(folder, output, trajectory, dataset, progress)
            without = set(range(len(trajectory))) - set(written)
        else:
            logger.warning(
                "%s does not record where its images are: the model has none; give --dataset",
                folder.path,
            )
        if what == "colmap":
            places = Places.read(folder.require(PLACES))
            model = _model_points(places, R_UP_WORLDS[up], cloud, points)
            write_colmap(output, places.intrinsics, trajectory.T_world_camera, *model, without)
        else:
            _write_scene(output, camera, trajectory, written, cloud)
    return output


def _check_target(what: str, output: Path) -> None:
    """Refuse, before anything is computed, what would replace a file of another kind."""
    suffixes = _SUFFIXES[what]
    if not suffixes and output.exists() and not output.is_dir():
        raise RunError(f"{output} is a file: {what} is several files, give the name of a folder")
    if suffixes and output.suffix.lower() not in suffixes:
        raise RunError(
            f"{what} is written as {' or '.join(suffixes)}; got '{output.name}', give a name that ends so"
        )
    if what in _MAPS:
        check_replaced(output, b"ply")
    elif what == "occupancy":
        refuse_foreign(
            [output.with_suffix(suffix) for suffix in suffixes], "occupied_thresh:", RunError
        )
    else:
        names, mark = _SCENES[what]
        refuse_foreign([output / name for name in names], mark, RunError)


def _export_occupancy(folder: RunFolder, output: Path, resolution: float) -> Path:
    unit = folder.metrics().unit
    if unit not in (METRES, CAMERA_HEIGHTS):
        raise RunError(
            f"heights above the road need metres or camera heights, but this run's lengths are in {unit}"
        )
    mesh, trajectory = _map(folder, "mesh", "z"), _trajectory(folder, "z")
    cells, corner = occupancy_grid(mesh, trajectory.T_world_camera, resolution, unit == METRES)
    written = output.with_suffix(".yaml")
    write_ros_map(written, cells, corner, resolution, unit)
    return written


def _map(folder: RunFolder, what: str, up: str) -> Ply:
    """The mesh or cloud of the map in the given axes."""
    ply = read_ply(folder.require(_MAPS[what]))
    return ply if up == "y-down" else rotated(ply, R_UP_WORLDS[up])


def _trajectory(folder: RunFolder, up: str) -> Trajectory:
    """The optimised trajectory in the given axes."""
    trajectory = read_trajectory(folder.require(ESTIMATE), "tum")
    frames = folder.metrics().sequence.frames
    if frames is not None and frames != len(trajectory):
        raise RunError(
            f"{folder.path}: {ESTIMATE} is damaged: it has {len(trajectory)} rows for {frames} frames"
        )
    return replace(
        trajectory,
        T_world_camera=se3.make(R_UP_WORLDS[up], np.zeros(3)) @ trajectory.T_world_camera,
    )


def _model_points(
    places: Places, R_up_world: FloatArray, cloud: Ply | None, at_most: int | None
) -> tuple[FloatArray, NDArray[np.uint8], Sightings]:
    """Points ``(P, 3)`` of a model and their colours: corners tracked through the images, then the cloud of the map.

    Of more than ``at_most`` those with the longest tracks are taken.
    """
    points, none = np.zeros((0, 3)), np.zeros(0, np.intp)
    sightings = Sightings(none, np.zeros((0, 2)), none, np.zeros(0))
    if places.views:
        structure = PlaceStructure(places, OF_KEYFRAMES)
        tracks = structure.tracks()
        length = np.bincount(tracks.point, minlength=len(tracks.points))
        is_known = np.isfinite(tracks.points).all(axis=1)
        chosen = np.argsort(np.where(is_known, -length, 1), kind="stable")[: int(is_known.sum())][
            :at_most
        ]
        number = np.full(len(tracks.points), -1)
        number[chosen] = np.arange(len(chosen))
        kept = number[tracks.point] >= 0
        views, corners = tracks.views[kept], tracks.corners[kept]
        frames = np.array([view.index for view in places.views], np.intp)[views]
        pixels, errors_px = structure.pixels(views, corners), tracks.errors_px[kept]
        points = tracks.points[chosen] @ R_up_world.T
        sightings = Sightings(frames, pixels, number[tracks.point[kept]], errors_px)
    colours = np.full((len(points), 3), _GREY, np.uint8)
    if cloud is not None:
        if len(points):
            colours = cloud.colours[cKDTree(cloud.points).query(points)[1]]
        most = len(cloud.points)
        count = most if at_most is None else min(at_most - len(points), most)
        rows = np.linspace(0, most - 1, count).round().astype(np.intp)
        points = np.concatenate([points, cloud.points[rows]])
        colours = np.concatenate([colours, cloud.colours[rows]])
    return points, colours, sightings


def _write_scene(
    output: Path, camera: Intrinsics, trajectory: Trajectory, frames: list[int], cloud: Ply | None
) -> None:
    """Write ``points.ply`` and, last, ``transforms.json``, which tools for Gaussian splatting read.

    Its cameras have OpenGL's axes: x right, y up, z backwards.
    """
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
    poses = (trajectory.T_world_camera[frames] @ _T_CAMERA_OPENGL).tolist()
    scene["frames"] = [
        {"file_path": _image_name(k), "transform_matrix": pose} for k, pose in zip(frames, poses)
    ]
    text = json.dumps(scene, indent=2, allow_nan=False) + "\n"
    write_atomically(output / TRANSFORMS, text, RunError)


def _write_images(
    folder: RunFolder,
    output: Path,
    trajectory: Trajectory,
    dataset: Path | None,
    progress: Progress,
) -> tuple[Intrinsics, list[int]]:
    """Write ``images/NNNNNN.png`` of all frames with a usable image; they are returned, with their camera."""
    sequence, rows = _recording(folder, trajectory, dataset)
    written, without = [], _interpolated(folder)
    for k, row in enumerate(rows):
        progress("images", k + 1, len(rows))
        if row is None or k in without:
            continue
        try:
            image = sequence.frame(row).image
        except OneLineError:
            continue
        content = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()
        write_atomically(output / _image_name(k), content, RunError)
        written.append(k)
    if not written:
        raise RunError(f"no image of {folder.path} can be read: check the data set")
    if len(written) < len(rows):
        logger.warning(
            "%d of %d frames have no usable image: left out", len(rows) - len(written), len(rows)
        )
    # for erfsfm train, which takes images without distortion alone
    rate = 1.0 / median(np.diff(sequence.stamps))
    seen = sequence.intrinsics
    camera = CameraFile(**vars(Pinhole.of(seen)), fps=rate, fx_sigma=seen.focal_sigma)
    write_camera(output, camera, sequence.fixed)
    return seen, written


def _image_name(frame: int) -> str:
    """Of the image of a frame, seen from the scene's folder."""
    return f"{_IMAGES}/{frame:06d}.png"


def _recording(
    folder: RunFolder, trajectory: Trajectory, dataset: Path | None
) -> tuple[RecordedSequence, list[int | None]]:
    """The recording of a run, and which frame of it, by its stamp, each row of the trajectory is."""
    recorded = folder.metrics().provenance.recording
    if recorded is None and dataset is None:
        raise RunError(f"{folder.path} does not record where its images are: give --dataset ROOT")
    recorded = recorded or {}
    place, camera = (
        Path(recorded[name]) if name in recorded else None for name in ("dataset", "camera")
    )
    if (own_camera := folder.path / CAMERA_FILE).is_file():
        camera = own_camera
    elif dataset is not None and camera is not None and not camera.exists():
        camera = None  # it may have moved with the images
    try:
        sequence = open_or_embedded(dataset or place, recorded.get("sequence"), camera)
    except OneLineError as error:
        raise RunError(
            f"the images of {folder.path} are needed and not found ({error}); give --dataset ROOT"
        ) from error
    own = Places.read(folder.require(PLACES)).intrinsics
    expected, found = (
        (each.width, each.height, each.fx, each.fy, each.cx, each.cy)
        for each in (own, sequence.intrinsics)
    )
    if not np.allclose(expected, found, atol=_SAME_PIXEL):
        raise RunError(
            f"{sequence.name} has another camera than {folder.path}: give the data set of the run"
        )
    stamps = np.asarray(sequence.stamps)
    nearest = nearest_stamps(trajectory.stamps, stamps)
    same = np.abs(stamps[nearest] - trajectory.stamps) < _SAME_STAMP_S
    if not same.any():
        raise RunError(
            f"{sequence.name} has no frame at the times of {folder.path}: give the data set of the run"
        )
    return sequence, [
        row if is_same else None for row, is_same in zip(nearest.tolist(), same, strict=True)
    ]


def _interpolated(folder: RunFolder) -> set[int]:
    """Frames of a run without a usable image."""
    return {
        k for gap in folder.metrics().sequence.bridged or () for k in range(gap.first, gap.last + 1)
    }
