"""KITTI odometry roots, real or simulated.

``sequences/NN/{image_2/NNNNNN.png, calib.txt, times.txt}`` and ``poses/NN.txt``, which are of camera 0.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from erfsfm.common.readers.camera_file import CameraFile
from erfsfm.common.readers.images import list_images
from erfsfm.common.readers.kitti_calibration import CAMERA_HEIGHT_M, ODOMETRY_CALIBRATION, CalibrationFile
from erfsfm.common.readers.kitti_drives import ODOMETRY_CAMERAS, OdometryRoot, find_odometry_root, odometry_camera
from erfsfm.common.readers.numbering import NumberedFiles, by_number
from slam.formats.trajectory import read_trajectory
from slam.frames import Intrinsics
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import explicit_camera, mount_beside
from slam.sequences.depth_maps import depth_maps_in
from slam.sequences.images import ImageFiles
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.poses import poses_near
from slam.sequences.recording import (
    RecordedSequence,
    Source,
    fallback_stamps,
    read_stamps,
    scans_in,
)
from slam.sequences.true_mesh import distance_to_mesh


def open_kitti_odometry(root: OdometryRoot, name: str, asked: Path | None) -> RecordedSequence:
    """Open one sequence of an odometry root.

    The camera that was ``asked`` for, if any, replaces the root's calibration and camera height.

    Raises:
        SequenceError, DataError: if images, ``calib.txt``, ``times.txt`` or the poses are missing or do not match.
    """
    folder = root.sequences / name
    number = odometry_camera(folder)
    if number is None:
        raise SequenceError(_no_images(folder))
    files = by_number(list_images(folder / f"image_{number}"))
    stored = ImageFiles(files)
    stamps = _stamps(folder / "times.txt", files)
    calibration = CalibrationFile(folder / ODOMETRY_CALIBRATION)
    T_camera_cam0 = calibration.T_camera_cam0(f"P{number}")
    simulated = root.simulation_seed()
    camera: CameraFile | Intrinsics
    if asked is None:
        pinhole = calibration.pinhole(f"P{number}", stored.width, stored.height)
        usual_m = CAMERA_HEIGHT_M if simulated is None else None
        height_m, readout_s = mount_beside(pinhole, usual_m, root.base)
        camera = replace(Intrinsics.of(pinhole), readout_s=readout_s)
    else:
        camera, height_m = explicit_camera(asked, stored), CAMERA_HEIGHT_M
    return RecordedSequence(
        name=name,
        images=stored,
        camera=camera,
        stamps=stamps,
        sources=(_source(root, name, files.first),),
        T_any_camera=_true_poses(root.base / "poses" / f"{name}.txt", files, stamps, T_camera_cam0),
        usual_height_m=height_m,
        T_camera_lidar=_T_camera_lidar(calibration, T_camera_cam0),
        scans=scans_in(folder / "velodyne", files),
        depth_maps=depth_maps_in(folder / f"depth_{number}", files),
        distance_to_surface=None if simulated is None else distance_to_mesh(root.base / "mesh.ply"),
    )


def _no_images(folder: Path) -> str:
    names = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else ["no such folder"]
    found = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
    looked = ", ".join(f"image_{camera}" for camera in ODOMETRY_CAMERAS)
    return f"no images in {folder}: looked for png or jpg in {looked}; found {found or 'an empty folder'}"


def _stamps(path: Path, files: NumberedFiles) -> FloatArray:
    if not path.exists():
        return fallback_stamps(path, len(files))
    return read_stamps(path, files)


def _true_poses(path: Path, files: NumberedFiles, stamps: FloatArray, T_camera_cam0: FloatArray) -> FloatArray | None:
    """Poses of the camera in use from poses of camera 0; None where the root has no poses."""
    if not path.exists():
        return None
    found = read_trajectory(path, format="kitti")
    assigned = files.rows_of(found.frame_count)
    if assigned is None:
        raise SequenceError(
            f"{path} has {found.frame_count} poses for {len(files.paths)} images: restore the missing images, or cut "
            f"the poses to match, or remove the file to run without a reference"
        )
    rows, skipped = assigned
    places = found.frame_numbers - skipped
    of_images = places >= 0
    T_any_camera = found.T_world_camera[of_images] @ se3.invert(T_camera_cam0)
    return poses_near(T_any_camera, stamps[rows[places[of_images]]], stamps, path)


def _T_camera_lidar(calibration: CalibrationFile, T_camera_cam0: FloatArray) -> FloatArray | None:
    """LiDAR to the camera in use; some calibrations write ``Tr``, others ``Tr_velo_to_cam``."""
    key = next((key for key in ("Tr", "Tr_velo_to_cam") if key in calibration), None)
    if key is None:
        return None
    T_cam0_lidar = np.vstack([calibration.matrix(key, (3, 4)), [0.0, 0.0, 0.0, 1.0]])
    T_camera_lidar: FloatArray = T_camera_cam0 @ T_cam0_lidar
    return T_camera_lidar


def _source(root: OdometryRoot, name: str, first: int) -> Source:
    simulated = root.simulation_seed() is not None
    return Source(root.recording_name(name), first=None if simulated else first)


def _find(path: Path, asked: Asked) -> dict[str, Opener]:
    """The sequences of a root, or the one whose own folder is given."""
    root = find_odometry_root(path)
    if root is not None:
        names = root.names()
        if asked.name is not None and asked.name not in names and (root.sequences / asked.name).is_dir():
            names.append(asked.name)  # for the error about what it lacks
        return {name: partial(open_kitti_odometry, root, name, asked.camera) for name in names}
    where = path.absolute()
    above = find_odometry_root(where.parent) if where.parent.name == "sequences" else None
    if above is None or odometry_camera(path) is None:
        return {}
    return {where.name: partial(open_kitti_odometry, above, where.name, asked.camera)}


LOADER = Loader("KITTI odometry", "sequences/NN/image_2", _find)
