"""The layouts of public data sets but KITTI's: a row of ``LOADERS`` each.

EuRoC (Burri et al. 2016), TUM RGB-D (Sturm et al. 2012), TUM's monocular benchmark (Engel et al. 2016), 7-Scenes
(Shotton et al. 2013), ScanNet (Dai et al. 2017) and nuScenes (Caesar et al. 2020).
"""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from erfsfm.common.errors import ErfsfmError
from erfsfm.common.files import read_text
from erfsfm.common.readers.camera_file import CameraFile, camera_of
from erfsfm.common.readers.images import first_size, has_images, list_images, read_depth_map
from erfsfm.common.readers.kitti import read_velodyne
from erfsfm.common.readers.numbering import NumberedFiles, by_name, by_table
from slam.formats.rows import BadRows, in_seconds, number_or_nan, rows_of
from slam.formats.trajectory import nearest_pairs, read_trajectory
from slam.geometry import se3
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import (
    beside,
    find_camera_file,
    pinhole_keys,
    read_explicit,
    read_opencv_yaml,
)
from slam.sequences.images import ImageFiles
from slam.sequences.loader import Asked, Loader, Openers
from slam.sequences.poses import pose_files, poses_near, poses_of, read_matrix
from slam.sequences.recording import (
    ArrayReaders,
    RecordedSequence,
    Source,
    read_stamps,
    require_stamps,
)

logger = logging.getLogger(__name__)

_NEAR_S = 0.05  # of a LiDAR scan to its image
_NEAR_DEPTH_S = 0.02
_FPS = 30.0  # of the cameras of 7-Scenes and ScanNet
_TUM_PER_METRE = 5000.0
_SEVEN_SCENES_UNKNOWN = 65535
_RIGID_TOLERANCE = 0.01
_EUROC_CAMERAS = ("cam0", "cam1")
_EUROC_TRUTH = ("state_groundtruth_estimate0", "mocap0", "vicon0")  # the first that is there
_EUROC_POSITIONS = "leica0"
_TUM_INDEX, _TUM_DEPTH = "rgb.txt", "depth.txt"
_FREIBURG = re.compile(r"freiburg(?P<camera>[123])")
_SEVEN_SCENES_IMAGE = re.compile(r"frame-(\d{6})\.color\.png")
_NUSCENES_FPS = 12.0

Row = dict[str, Any]
# the benchmark's table of its three cameras: fx, fy, cx, cy and the distortion; images of freiburg3 are undistorted
_FREIBURG_CAMERAS = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}
_SCANNET_CAMERA = "intrinsic/intrinsic_color.txt"


def _recorded(
    data_set: str,
    name: str,
    files: NumberedFiles,
    stamps: FloatArray,
    asked: Path | None,
    places: Sequence[Path],
    own: Callable[[], CameraFile] | None,
    first: int = 0,
    **known: Any,
) -> RecordedSequence:
    """A recording of image files, the ``first`` of them by the data set's own numbers, with what is ``known`` beside.

    ``places`` may have a ``camera.yaml``; ``own`` reads the calibration of the data set.
    """
    stored = ImageFiles(files)
    camera = find_camera_file(
        asked, *places, wanted_by=f"{name} in {places[0]}", images=stored, own=own
    )
    sources = (Source(f"{data_set}/{name}", first=first),)
    return RecordedSequence(name, stored, camera, stamps, sources, **known)


def _index(
    table: Path, folder: Path, in_nanoseconds: bool = False
) -> tuple[FloatArray, list[Path]]:
    """Stamps in seconds and files, which are in ``folder``, of a table of both, good rows in the order of time."""
    wanted = "'nanoseconds,file'" if in_nanoseconds else "'stamp file'"
    bad, numbers, stamps, files = BadRows(table, SequenceError), [], [], []
    for number, line in rows_of(table, SequenceError, f"rows of {wanted}"):
        words = line.replace(",", " ").split() or [""]
        is_whole = in_nanoseconds and words[0].isdecimal()
        stamp = int(words[0]) / 10**9 if is_whole else number_or_nan(in_seconds(words[0]))
        if len(words) == 2 and math.isfinite(stamp):
            numbers.append(number)
            stamps.append(stamp)
            files.append(folder / words[1])
        else:
            bad.add(number, f"{line!r} is not {wanted}")
    order = bad.in_order(
        np.array(stamps), "stamps", np.array(numbers, np.intp), f"rows of {wanted}"
    )
    return np.array(stamps)[order], [files[k] for k in order]


def _depth_maps(paths: list[Path], unknown: int = 0) -> ArrayReaders:
    """In millimetres, of the frames whose files are there."""
    return {
        k: partial(read_depth_map, path, 1000.0, unknown)
        for k, path in enumerate(paths)
        if path.is_file()
    }


def _truth(path: Path, stamps: FloatArray) -> FloatArray | None:
    """``T_any_camera`` of a file in TUM's format at the images' stamps, NaN where unknown; None without it."""
    if not path.exists():
        return None
    truth = read_trajectory(path, "tum")
    return poses_near(truth.T_world_camera, truth.stamps, stamps, path)


# EuRoC: mav0/cam0/{data.csv,sensor.yaml,data/STAMP.png}, true poses of the body


def _find_euroc(path: Path, asked: Asked) -> Openers:
    """The left camera, else the right one, of the sensors in ``mav0`` of a recording, or in the folder given."""
    path = path.absolute()
    for body in (path / "mav0", path):
        for name in _EUROC_CAMERAS:
            camera = body / name
            if (camera / "data.csv").is_file():
                return {body.parent.name: partial(_open_euroc, camera, asked.camera)}
    return {}


def _open_euroc(camera: Path, asked: Path | None) -> RecordedSequence:
    """Rows of ``data.csv`` without an image are gaps in time."""
    body = camera.parent
    stamps, listed = _index(camera / "data.csv", camera / "data", in_nanoseconds=True)
    files, sensor = by_table(listed, camera / "data.csv"), camera / "sensor.yaml"
    stamps = stamps[files.first :][: len(files)]
    truth = _euroc_truth(body, stamps, sensor)
    places = body, body.parent
    own = partial(read_explicit, sensor)
    return _recorded(
        "euroc", body.parent.name, files, stamps, asked, places, own, T_any_camera=truth
    )


def _euroc_truth(body: Path, stamps: FloatArray, camera: Path) -> FloatArray | None:
    """``T_any_camera`` at the images' stamps; ``camera`` is the ``sensor.yaml`` that says where the camera sits."""
    folder = next(
        (body / name for name in _EUROC_TRUTH if (body / name / "data.csv").exists()), None
    )
    if folder is None:
        if (body / _EUROC_POSITIONS).is_dir():
            logger.warning(
                "%s has true positions without rotations: they are not used",
                body / _EUROC_POSITIONS,
            )
        return None
    table, sensor = folder / "data.csv", folder / "sensor.yaml"
    if not camera.exists():
        logger.warning(
            "%s is not used: %s, which says where the camera sits, is missing", table, camera
        )
        return None
    truth = read_trajectory(table)
    T_body_sensor = _T_body_sensor(sensor) if sensor.exists() else np.eye(4)
    T_any_camera = truth.T_world_camera @ se3.invert(T_body_sensor) @ _T_body_sensor(camera)
    return poses_near(T_any_camera, truth.stamps, stamps, table)


def _T_body_sensor(path: Path) -> FloatArray:
    """The pose of a sensor in the body ``(4, 4)`` by its ``sensor.yaml``."""
    try:
        T_body_sensor = np.array(read_opencv_yaml(path)["T_BS"]["data"], dtype=np.float64).reshape(
            4, 4
        )
    except (OSError, KeyError, TypeError, ValueError, ErfsfmError) as error:
        raise SequenceError(f"{path} needs T_BS with data of 4 x 4 numbers: {error}") from error
    if not se3.is_se3(T_body_sensor, _RIGID_TOLERANCE):
        raise SequenceError(
            f"{path} has a T_BS that is no rotation and translation: restore the file"
        )
    return T_body_sensor


# TUM RGB-D: rgb.txt and, where known, groundtruth.txt and depth.txt


def _freiburg_camera(number: str) -> CameraFile:
    pinhole, distortion = _FREIBURG_CAMERAS[number]
    lens = {"model": "opencv", "distortion": distortion} if distortion else {}
    return camera_of(pinhole_keys(640, 480, *pinhole, fps=_FPS, **lens), f"freiburg{number}")


def _open_tum(folder: Path, asked: Path | None) -> RecordedSequence:
    """Rows without an image are gaps in time; without a ``camera.yaml`` the folder's name tells a published camera."""
    stamps, listed = _index(folder / _TUM_INDEX, folder)
    files = by_table(listed, folder / _TUM_INDEX)
    stamps = stamps[files.first :][: len(files)]
    places, match = (folder, folder.parent), _FREIBURG.search(folder.name)
    is_published = match is not None and beside(*places) is None
    own = partial(_freiburg_camera, match["camera"]) if match is not None and is_published else None
    depth_maps: ArrayReaders = {}
    if (folder / _TUM_DEPTH).exists():
        known, paths = _index(folder / _TUM_DEPTH, folder)
        for k, row in zip(*nearest_pairs(stamps, known, _NEAR_DEPTH_S)):
            depth_maps[int(k)] = partial(read_depth_map, paths[row], _TUM_PER_METRE)
    truth = _truth(folder / "groundtruth.txt", stamps)
    return _recorded(
        "tum",
        folder.name,
        files,
        stamps,
        asked,
        places,
        own,
        T_any_camera=truth,
        depth_maps=depth_maps,
    )


# TUM mono: images/, times.txt and camera.txt with the FOV lens; true poses of the start and the end alone


def _open_tum_mono(folder: Path, asked: Path | None) -> RecordedSequence:
    """Response and vignette (``pcalib.txt``, ``vignette.png``) are not used."""
    if not has_images(folder / "images"):
        raise SequenceError(f"no images in {folder / 'images'}: unpack images.zip there")
    files = by_name(list_images(folder / "images"))
    stamps = read_stamps(folder / "times.txt", files)
    fps = 1.0 / median(np.diff(stamps)) if len(stamps) > 1 else 1.0
    truth = _truth(folder / "groundtruthSync.txt", stamps)
    own = partial(_fov_camera, folder / "camera.txt", fps)
    return _recorded(
        "tum_mono", folder.name, files, stamps, asked, [folder], own, T_any_camera=truth
    )


def _fov_camera(path: Path, fps: float) -> CameraFile:
    """Focal lengths and principal point over the image's size, and the angle of the lens; then the size."""
    try:
        first, second = read_text(path).splitlines()[:2]
        words = first.split()
        fx, fy, cx, cy, angle = map(float, words[words[0] == "FOV" :])
        width, height = map(int, second.split())
    except (OSError, UnicodeDecodeError, ValueError, IndexError) as error:
        raise SequenceError(
            f"{path} needs a row of fx fy cx cy and the lens's angle and a row of width and height: {error}"
        ) from error
    lens = {"model": "fov", "distortion": [angle]} if angle else {}
    pinhole = fx * width, fy * height, cx * width - 0.5, cy * height - 0.5
    return camera_of(pinhole_keys(width, height, *pinhole, fps=fps, **lens), str(path))


# 7-Scenes: seq-01/frame-000000.{color.png,depth.png,pose.txt}


def _open_seven_scenes(folder: Path, asked: Path | None) -> RecordedSequence:
    """With the camera that the data set publishes for all."""
    named = (_SEVEN_SCENES_IMAGE.fullmatch(path.name) for path in folder.iterdir())
    numbers = sorted(int(match[1]) for match in named if match)
    if not numbers:
        raise SequenceError(f"no frame-NNNNNN.color.png in {folder}: unpack the sequence")
    frames = [folder / f"frame-{k:06d}" for k in range(numbers[0], numbers[-1] + 1)]
    files = by_table([frame.with_suffix(".color.png") for frame in frames], folder)
    stamps = np.arange(numbers[0], numbers[-1] + 1) / _FPS
    name, places = f"{folder.parent.name}_{folder.name}", (folder, folder.parent)
    keys = pinhole_keys(640, 480, 585.0, 585.0, 320.0, 240.0, fps=_FPS)
    own = partial(CameraFile, **keys)
    depths = [frame.with_suffix(".depth.png") for frame in frames]
    return _recorded(
        "7scenes",
        name,
        files,
        stamps,
        asked,
        places,
        own,
        numbers[0],
        T_any_camera=pose_files([frame.with_suffix(".pose.txt") for frame in frames], stamps),
        depth_maps=_depth_maps(depths, _SEVEN_SCENES_UNKNOWN),
    )


# ScanNet as its reader exports it: {color/0.jpg,depth/0.png,pose/0.txt,intrinsic}


def _open_scannet(folder: Path, asked: Path | None) -> RecordedSequence:
    """Stamps follow from the numbers of the images, also where every n-th was exported."""
    paths = list_images(folder / "color")
    for path in paths:
        if not path.stem.isdecimal():
            raise SequenceError(f"{path} is not named by its number, as 0.jpg: rename it")
    files = by_name(paths)
    there = [int(path.stem) for path in files.paths]
    numbers = np.interp(np.arange(len(files)), files.rows, there).round().astype(int).tolist()
    stamps = np.array(numbers) / _FPS
    own = partial(_scannet_camera, folder / _SCANNET_CAMERA, files)
    return _recorded(
        "scannet",
        folder.name,
        files,
        stamps,
        asked,
        [folder],
        own,
        numbers[0],
        T_any_camera=pose_files([folder / "pose" / f"{k}.txt" for k in numbers], stamps),
        depth_maps=_depth_maps([folder / "depth" / f"{k}.png" for k in numbers]),
    )


def _scannet_camera(path: Path, files: NumberedFiles) -> CameraFile:
    K, (height, width) = read_matrix(path, "a camera"), first_size(files.paths)
    return camera_of(
        pinhole_keys(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], fps=_FPS), str(path)
    )


# nuScenes: the tables v1.0-*/scene.json and others, with microseconds


def _open_nuscenes(root: Path, tables: Path, scene: str, asked: Path | None) -> RecordedSequence:
    """The front camera, key frames and sweeps; its height is that over the ego frame, which lies on the ground."""
    try:
        rows = _scene(tables, scene)
        front, lidar = rows["CAM_FRONT"], rows.get("LIDAR_TOP", [])
        table = tables / "sample_data.json"
        files = by_table([root / row["filename"] for row in front], table)
        stamps = require_stamps(_times(front)[: files.first + len(files)], table, files)
        shown = front[files.first :][: len(files)]
        (T_ego_camera,) = _nuscenes_poses([front[0]["mount"]])
        T_any_camera = _nuscenes_poses([row["ego_pose"] for row in shown]) @ T_ego_camera
        (fx, _, cx), (_, fy, cy), _ = front[0]["mount"]["camera_intrinsic"]
        height_m = float(T_ego_camera[2, 3])
        size = front[0]["width"], front[0]["height"]
        keys = pinhole_keys(*size, fx, fy, cx, cy, fps=_NUSCENES_FPS, camera_height_m=height_m)
        scans: ArrayReaders = {}
        T_camera_lidar = None
        if lidar:
            (T_ego_lidar,) = _nuscenes_poses([lidar[0]["mount"]])
            T_camera_lidar = se3.invert(T_ego_camera) @ T_ego_lidar
            for k, row in zip(*nearest_pairs(stamps, _times(lidar), _NEAR_S)):
                path = root / lidar[row]["filename"]
                if path.exists():
                    scans[int(k)] = partial(read_velodyne, path, 5)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise SequenceError(
            f"the tables in {tables} are not those of nuScenes: {error!r}; copy them again"
        ) from error
    own = partial(camera_of, keys, str(tables / "calibrated_sensor.json"))
    return _recorded(
        "nuscenes",
        scene,
        files,
        stamps,
        asked,
        [root],
        own,
        files.first,
        T_any_camera=T_any_camera,
        T_camera_lidar=T_camera_lidar,
        scans=scans,
    )


def _scene(tables: Path, scene: str) -> dict[str, list[Row]]:
    """The rows of each sensor of a scene in the order of time, with the ``mount`` of it and the ``ego_pose`` then."""
    (token,) = (row["token"] for row in _table(tables, "scene") if row["name"] == scene)
    samples = {row["token"] for row in _table(tables, "sample") if row["scene_token"] == token}
    names = "sensor", "calibrated_sensor", "ego_pose"
    sensors, mounts, ego_poses = (_by_token(_table(tables, name)) for name in names)
    rows: dict[str, list[Row]] = {}
    for row in sorted(_table(tables, "sample_data"), key=lambda row: float(row["timestamp"])):
        if row["sample_token"] in samples:
            mount = mounts[row["calibrated_sensor_token"]]
            row |= {"mount": mount, "ego_pose": ego_poses[row["ego_pose_token"]]}
            rows.setdefault(sensors[mount["sensor_token"]]["channel"], []).append(row)
    return rows


def _by_token(rows: list[Row]) -> dict[str, Row]:
    return {row["token"]: row for row in rows}


def _table(tables: Path, name: str) -> list[Row]:
    path = tables / f"{name}.json"
    try:
        rows = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise SequenceError(f"cannot read table {path}: {error}; copy it again") from error
    if not isinstance(rows, list):
        raise SequenceError(f"{path} is no table of nuScenes: wanted a list of rows; copy it again")
    return rows


def _times(rows: list[Row]) -> FloatArray:
    return np.array([row["timestamp"] / 1e6 for row in rows])


def _nuscenes_poses(rows: list[Row]) -> FloatArray:
    """Poses ``(N, 4, 4)`` of rows with a translation and a rotation as quaternion wxyz."""
    positions = np.array([row["translation"] for row in rows], dtype=np.float64)
    quaternions = np.array([row["rotation"] for row in rows], dtype=np.float64)
    return poses_of(positions, quaternions[:, [1, 2, 3, 0]])


def _find_nuscenes(path: Path, asked: Asked) -> Openers:
    """All scenes of all tables."""
    folders = sorted(folder for folder in path.glob("v1.0-*") if (folder / "scene.json").is_file())
    scenes: Openers = {}
    for folder in folders:
        for row in _table(folder, "scene"):
            name = row.get("name") if isinstance(row, dict) else None
            if isinstance(name, str):
                scenes[name] = partial(_open_nuscenes, path, folder, name, asked.camera)
    return scenes


def _loader(
    kind: str,
    layout: str,
    is_one: Callable[[Path], bool],
    open_one: Callable[[Path, Path | None], RecordedSequence],
    inside: str = "",
) -> Loader:
    """A loader of folders that ``is_one`` recognises, of the one given or of those ``inside`` it."""

    def find(path: Path, asked: Asked) -> Openers:
        path = path.absolute()
        found = (
            [path] if is_one(path) else sorted(filter(is_one, path.glob(inside))) if inside else []
        )
        return {folder.name: partial(open_one, folder, asked.camera) for folder in found}

    return Loader(kind, layout, find)


LOADERS = (
    Loader("EuRoC", "mav0/cam0/data.csv", _find_euroc),
    _loader("TUM RGB-D", _TUM_INDEX, lambda path: (path / _TUM_INDEX).exists(), _open_tum),
    _loader(
        "TUM mono",
        "camera.txt and times.txt",
        lambda path: (path / "camera.txt").is_file() and (path / "times.txt").is_file(),
        _open_tum_mono,
    ),
    _loader(
        "7-Scenes",
        "seq-01/frame-000000.color.png",
        lambda path: path.is_dir() and any(path.glob("frame-*.color.png")),
        _open_seven_scenes,
        "seq-*",
    ),
    _loader(
        "ScanNet",
        f"color/0.jpg with {_SCANNET_CAMERA}",
        lambda path: (path / _SCANNET_CAMERA).is_file() and has_images(path / "color"),
        _open_scannet,
    ),
    Loader("nuScenes", "v1.0-mini/scene.json", _find_nuscenes),
)
