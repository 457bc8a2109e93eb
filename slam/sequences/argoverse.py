"""Argoverse 2's front camera by the tables of a log: ``sensors/``, ``calibration/*.feather`` (Wilson et al. 2021)."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from erfsfm.common.errors import DataError
from erfsfm.common.readers.camera_file import camera_of
from erfsfm.common.readers.images import has_images, list_images
from erfsfm.common.readers.numbering import by_name
from erfsfm.common.readers.scan import measured_points
from slam.formats.trajectory import nearest_pairs
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.runtime.imports import import_extra
from slam.sequences.camera_file import own_camera
from slam.sequences.images import ImageFiles
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.poses import poses_near, poses_of
from slam.sequences.recording import RecordedSequence, ScanReader, Source, require_stamps

_CAMERA = "ring_front_center"
_IMAGES, _SCANS = f"sensors/cameras/{_CAMERA}", "sensors/lidar"
_INTRINSICS, _EXTRINSICS = "calibration/intrinsics.feather", "calibration/egovehicle_SE3_sensor.feather"
_POSES = "city_SE3_egovehicle.feather"
_NANOSECONDS = 10**9
_SCAN_DELAY_S = 0.05
_FPS = 20.0

Table = dict[str, list[Any]]


def open_argoverse(log: Path, asked: Path | None) -> RecordedSequence:
    """Open the front camera of a log, with the nearest LiDAR sweep within 50 ms of each image.

    As the data set's own camera does, the coefficients of the lens are left out: images are of a pinhole. Sweeps lie
    in the frame of the car.

    Raises:
        SequenceError, DataError: if images or tables are missing or malformed, or pyarrow is not installed.
    """
    log = log.absolute()
    files = by_name(list_images(log / _IMAGES))
    stored = ImageFiles(files)
    stamps = require_stamps(np.array([_stamp(path) for path in files.paths]), log / _IMAGES, files)
    try:
        lens = _row(_read(log / _INTRINSICS), _CAMERA)
        keys = {"width": lens["width_px"], "height": lens["height_px"], "fps": _FPS}
        focal = {key: lens[f"{key}_px"] for key in ("fx", "fy", "cx", "cy")}
        own = partial(camera_of, keys | focal, str(log / _INTRINSICS))
        mount = _row(_read(log / _EXTRINSICS), _CAMERA)
        (T_ego_camera,) = _poses({key: [value] for key, value in mount.items()})
        driven = _read(log / _POSES)
        known = np.array([int(ns) / _NANOSECONDS for ns in driven["timestamp_ns"]])
        T_any_camera = poses_near(_poses(driven) @ T_ego_camera, known, stamps, log / _POSES)
    except (KeyError, TypeError, ValueError) as error:
        raise SequenceError(f"the tables in {log} are not those of Argoverse 2: {error!r}; copy them again") from error
    camera = own_camera(own, asked, stored, log, log.parent)
    return RecordedSequence(
        name=log.name,
        images=stored,
        camera=camera,
        stamps=stamps,
        sources=(Source(f"argoverse2/{log.name}"),),
        T_any_camera=T_any_camera,
        T_camera_lidar=se3.invert(T_ego_camera),
        scans=_scans(log / _SCANS, stamps),
    )


def _stamp(path: Path) -> float:
    try:
        return int(path.stem) / _NANOSECONDS
    except ValueError:
        raise SequenceError(f"{path} is not named by its stamp in nanoseconds: copy the log again") from None


def _read(path: Path) -> Table:
    """A feather file by columns."""
    (feather,) = import_extra("argoverse")
    try:
        table: Table = feather.read_table(path).to_pydict()
    except (OSError, ValueError, MemoryError, SystemError) as error:  # pyarrow's own, also of sizes that cannot be
        raise SequenceError(f"cannot read table {path}: {' '.join(str(error).split())}; copy it again") from error
    return table


def _row(table: Table, sensor: str) -> dict[str, Any]:
    """The row of a sensor."""
    row = table["sensor_name"].index(sensor)
    return {key: values[row] for key, values in table.items()}


def _poses(table: Table) -> FloatArray:
    """Poses ``(N, 4, 4)`` of a table of quaternions and translations."""
    position, quaternion = (
        np.column_stack([np.asarray(table[key], np.float64) for key in keys])
        for keys in (("tx_m", "ty_m", "tz_m"), ("qx", "qy", "qz", "qw"))
    )
    return poses_of(position, quaternion)


def _scans(folder: Path, stamps: FloatArray) -> dict[int, ScanReader]:
    paths = sorted(folder.glob("*.feather"))
    if not paths:
        return {}
    known = np.array([_stamp(path) for path in paths])
    pairs = zip(*nearest_pairs(stamps, known, _SCAN_DELAY_S))
    return {int(frame): partial(_points, paths[sweep]) for frame, sweep in pairs}


def _points(path: Path) -> FloatArray:
    table = _read(path)
    try:
        points = np.column_stack([np.asarray(table[axis], np.float64) for axis in "xyz"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path} is no sweep of Argoverse 2: {error!r}") from error
    return measured_points(points, path)


def _find(path: Path, asked: Asked) -> dict[str, Opener]:
    if not (path / _INTRINSICS).is_file() or not has_images(path / _IMAGES):
        return {}
    return {path.absolute().name: partial(open_argoverse, path, asked.camera)}


LOADER = Loader("Argoverse 2", _IMAGES, _find)
