"""nuScenes' front camera by the data set's own tables: ``v1.0-*/scene.json`` and others (Caesar et al. 2020)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from erfsfm.common.readers.camera_file import camera_of
from erfsfm.common.readers.kitti_sensors import read_velodyne
from erfsfm.common.readers.numbering import by_table
from slam.formats.trajectory import nearest_stamps
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import own_camera
from slam.sequences.images import ImageFiles
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.poses import poses_of
from slam.sequences.recording import RecordedSequence, ScanReader, Source, require_stamps

_CAMERA, _LIDAR = "CAM_FRONT", "LIDAR_TOP"
_TABLES = "v1.0-*"
_MICROSECONDS = 10**6
_LIDAR_COLUMNS = 5
_SCAN_DELAY_S = 0.05
_FPS = 12.0

Row = dict[str, Any]


def open_nuscenes(root: Path, tables: Path, scene: str, asked: Path | None) -> RecordedSequence:
    """Open the front camera of a scene, key frames and sweeps, with the nearest LiDAR scan within 50 ms of each image.

    The height of the camera is that over the ego frame, which lies on the ground.

    Raises:
        SequenceError, DataError: if a table or an image is missing or malformed.
    """
    try:
        front, lidar = _streams(tables, scene)
        stamps = np.array([row["timestamp"] / _MICROSECONDS for row in front.rows])
        files = by_table([root / row["filename"] for row in front.rows], tables / "sample_data.json")
        stamps = require_stamps(stamps[: files.first + len(files)], tables / "sample_data.json", files)
        shown = front.rows[files.first :][: len(files)]
        T_world_ego = _poses([front.ego_poses[row["ego_pose_token"]] for row in shown])
        (T_ego_camera,) = _poses([front.mount])
        K, size = np.array(front.mount["camera_intrinsic"]), (front.rows[0]["width"], front.rows[0]["height"])
        keys = {"width": size[0], "height": size[1], "fps": _FPS, "camera_height_m": float(T_ego_camera[2, 3])}
        keys |= {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        own = partial(camera_of, keys, str(tables / "calibrated_sensor.json"))
        T_camera_lidar, scans = (None, {}) if lidar is None else _scans(root, lidar, T_ego_camera, stamps)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise SequenceError(f"the tables in {tables} are not those of nuScenes: {error!r}; copy them again") from error
    stored = ImageFiles(files)
    camera = own_camera(own, asked, stored, root)
    return RecordedSequence(
        name=scene,
        images=stored,
        camera=camera,
        stamps=stamps,
        sources=(Source(f"nuscenes/{scene}", first=files.first),),
        T_any_camera=T_world_ego @ T_ego_camera,
        T_camera_lidar=T_camera_lidar,
        scans=scans,
    )


@dataclass(frozen=True)
class _Stream:
    """The rows of one sensor in a scene in the order of time, its mount, and the poses of the car."""

    rows: list[Row]
    mount: Row
    ego_poses: dict[str, Row]


def _streams(tables: Path, scene: str) -> tuple[_Stream, _Stream | None]:
    """The front camera and, where there is one, the LiDAR of a scene."""
    (token,) = (row["token"] for row in _table(tables, "scene") if row["name"] == scene)
    samples = {row["token"] for row in _table(tables, "sample") if row["scene_token"] == token}
    channels = {row["token"]: row["channel"] for row in _table(tables, "sensor")}
    mounts = {row["token"]: row for row in _table(tables, "calibrated_sensor")}
    rows = [row for row in _table(tables, "sample_data") if row["sample_token"] in samples]
    rows.sort(key=lambda row: row["timestamp"])
    used = {row["ego_pose_token"] for row in rows}
    ego_poses = {row["token"]: row for row in _table(tables, "ego_pose") if row["token"] in used}

    def stream(channel: str) -> _Stream | None:
        own = [row for row in rows if channels[mounts[row["calibrated_sensor_token"]]["sensor_token"]] == channel]
        return _Stream(own, mounts[own[0]["calibrated_sensor_token"]], ego_poses) if own else None

    front = stream(_CAMERA)
    if front is None:
        raise SequenceError(f"{scene} has no images of {_CAMERA} in {tables}")
    return front, stream(_LIDAR)


def _table(tables: Path, name: str) -> list[Row]:
    path = tables / f"{name}.json"
    try:
        rows = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise SequenceError(f"cannot read table {path}: {error}; copy it again") from error
    if not isinstance(rows, list):
        raise SequenceError(f"{path} is no table of nuScenes: wanted a list of rows; copy it again")
    return rows


def _poses(rows: list[Row]) -> FloatArray:
    """Poses ``(N, 4, 4)`` of rows with a translation and a rotation as quaternion wxyz."""
    positions = np.array([row["translation"] for row in rows], dtype=np.float64)
    quaternions = np.array([row["rotation"] for row in rows], dtype=np.float64)
    return poses_of(positions, quaternions[:, [1, 2, 3, 0]])


def _scans(
    root: Path, lidar: _Stream, T_ego_camera: FloatArray, stamps: FloatArray
) -> tuple[FloatArray, dict[int, ScanReader]]:
    """``T_camera_lidar`` and the scan of each frame that has one."""
    known = np.array([row["timestamp"] / _MICROSECONDS for row in lidar.rows])
    nearest = nearest_stamps(stamps, known)
    close = np.abs(known[nearest] - stamps) <= _SCAN_DELAY_S
    paths = {int(k): root / lidar.rows[nearest[k]]["filename"] for k in np.flatnonzero(close)}
    scans: dict[int, ScanReader] = {
        k: partial(read_velodyne, path, _LIDAR_COLUMNS) for k, path in paths.items() if path.exists()
    }
    (T_ego_lidar,) = _poses([lidar.mount])
    return se3.invert(T_ego_camera) @ T_ego_lidar, scans


def _find(path: Path, asked: Asked) -> dict[str, Opener]:
    """All scenes of all tables."""
    folders = sorted(folder for folder in path.glob(_TABLES) if (folder / "scene.json").is_file())
    return {
        row["name"]: partial(open_nuscenes, path, folder, row["name"], asked.camera)
        for folder in folders
        for row in _table(folder, "scene")
        if isinstance(row, dict) and isinstance(row.get("name"), str)
    }


LOADER = Loader("nuScenes", "v1.0-mini/scene.json", _find)
