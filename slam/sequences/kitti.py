"""KITTI's layouts: odometry roots, real or simulated, and raw drives with their GPS/INS (Geiger et al. 2013).

An odometry root has ``sequences/NN/{image_2/NNNNNN.png, calib.txt, times.txt}`` and ``poses/NN.txt`` of camera 0. A raw
drive is ``DATE/DATE_drive_NNNN_sync`` with its calibration one level up.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from erfsfm.common.files import read_text
from erfsfm.common.readers import kitti
from erfsfm.common.readers.camera_file import CameraFile, Pinhole
from erfsfm.common.readers.images import has_images, list_images, read_depth_map
from erfsfm.common.readers.kitti import CalibrationFile, OdometryRoot
from erfsfm.common.readers.numbering import NumberedFiles, by_number
from slam.formats.ply import distances, read_ply, scene_of
from slam.formats.trajectory import read_trajectory
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import DEFAULT_FPS, find_camera_file
from slam.sequences.images import ImageFiles
from slam.sequences.loader import Asked, Loader, Openers
from slam.sequences.poses import poses_near
from slam.sequences.recording import (
    ArrayReaders,
    RecordedSequence,
    Source,
    read_stamps,
    require_stamps,
    uniform_stamps,
)

logger = logging.getLogger(__name__)

_DEPTH_MAPS = "proj_depth/groundtruth"  # of KITTI's depth benchmark
_EPOCH = np.datetime64("2011-01-01", "ns")
_EARTH_RADIUS_M = 6378137.0
_RATES = slice(17, 20)  # of the angles, in a packet


def _open_odometry(root: OdometryRoot, name: str, asked: Path | None) -> RecordedSequence:
    """One sequence of an odometry root; a camera that was ``asked`` for replaces its calibration and camera height."""
    folder = root.sequences / name
    number = kitti.odometry_camera(folder)
    if number is None:
        looked = ", ".join(f"image_{camera}" for camera in kitti.ODOMETRY_CAMERAS)
        raise SequenceError(f"no images in {folder}: looked for png or jpg in {looked}")
    stored = ImageFiles(by_number(list_images(folder / f"image_{number}")))
    files, times = stored.files, folder / "times.txt"
    stamps = read_stamps(times, files) if times.exists() else _even(times, files)
    calibration = CalibrationFile(folder / kitti.ODOMETRY_CALIBRATION)
    T_camera_cam0 = calibration.T_camera_cam0(f"P{number}")
    simulated = root.simulation_seed()
    T_camera_lidar = None
    for key in ("Tr_velo_to_cam", "Tr"):
        if key in calibration:
            T_cam0_lidar = np.vstack([calibration.matrix(key, (3, 4)), [0.0, 0.0, 0.0, 1.0]])
            T_camera_lidar = T_camera_cam0 @ T_cam0_lidar
    return RecordedSequence(
        name=name,
        images=stored,
        camera=_camera(calibration.pinhole, f"P{number}", stored, asked, root.base),
        stamps=stamps,
        sources=(
            Source(root.recording_name(name), first=files.first if simulated is None else None),
        ),
        T_any_camera=_odometry_poses(
            root.base / "poses" / f"{name}.txt", files, stamps, T_camera_cam0
        ),
        usual_height_m=kitti.CAMERA_HEIGHT_M if simulated is None or asked is not None else None,
        T_camera_lidar=T_camera_lidar,
        scans=_readers(kitti.read_velodyne, folder / "velodyne", "*.bin", files),
        depth_maps=_readers(read_depth_map, folder / f"depth_{number}", "*.png", files),
        distance_to_surface=None
        if simulated is None
        else _distance_to_mesh(root.base / "mesh.ply"),
    )


def _open_raw(drive: Path, asked: Path | None) -> RecordedSequence:
    """One synced and rectified drive; its calibration is scaled to the images' true size."""
    drive = drive.absolute()
    number = next((c for c in kitti.RAW_CAMERAS if has_images(drive / f"image_{c}" / "data")), None)
    if number is None:
        looked = ", ".join(f"image_{c}/data" for c in kitti.RAW_CAMERAS)
        raise SequenceError(
            f"no images in {drive}: looked for png or jpg in {looked}; copy the drive again"
        )
    stored = ImageFiles(by_number(list_images(drive / f"image_{number}" / "data")))
    files, times = stored.files, drive / f"image_{number}" / "timestamps.txt"
    cameras = CalibrationFile(drive.parent / kitti.CAM_TO_CAM)
    known = _dates(times, files)
    stamps = _even(times, files) if known is None else known - known[0]
    T_camera_lidar = _T_camera_lidar(drive, cameras, number)
    name = kitti.drive_name(drive.name)
    places = drive, drive.parent, drive.parent.parent
    return RecordedSequence(
        name=name,
        images=stored,
        camera=_camera(cameras.rectified_pinhole, number, stored, asked, *places),
        stamps=stamps,
        sources=(Source(f"kitti_raw/{name}", first=files.first),),
        T_any_camera=_oxts_poses(drive, files, stamps, known, T_camera_lidar),
        usual_height_m=kitti.CAMERA_HEIGHT_M,
        T_camera_lidar=T_camera_lidar,
        scans=_readers(kitti.read_velodyne, drive / "velodyne_points/data", "*.bin", files),
        depth_maps=_readers(
            read_depth_map, drive / _DEPTH_MAPS / f"image_{number}", "*.png", files
        ),
    )


def _camera(
    pinhole: Callable[[str, int, int], Pinhole],
    key: str,
    stored: ImageFiles,
    asked: Path | None,
    *places: Path,
) -> CameraFile:
    def own() -> CameraFile:
        return CameraFile(**asdict(pinhole(key, stored.width, stored.height)), fps=DEFAULT_FPS)

    return find_camera_file(asked, *places, wanted_by="KITTI", images=stored, own=own)


def _even(path: Path, files: NumberedFiles) -> FloatArray:
    """Stamps in place of a missing file."""
    logger.warning("no %s: %g frames a second are assumed", path, DEFAULT_FPS)
    return uniform_stamps(len(files), DEFAULT_FPS)


def _dates(path: Path, files: NumberedFiles) -> FloatArray | None:
    """Seconds since KITTI's year began, one for each row of files, or None without ``path``."""
    if not path.exists():
        return None
    try:
        stamps = np.array(read_text(path).split("\n"), dtype="datetime64[ns]")
    except (OSError, ValueError) as error:
        raise SequenceError(f"{path} must hold a date and a time a row: {error}") from error
    seconds: FloatArray = (stamps[~np.isnat(stamps)] - _EPOCH).astype(np.float64) * 1e-9
    return require_stamps(seconds, path, files)


def _odometry_poses(
    path: Path, files: NumberedFiles, stamps: FloatArray, T_camera_cam0: FloatArray
) -> FloatArray | None:
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
    T_any_camera = found.T_world_camera[places >= 0] @ se3.invert(T_camera_cam0)
    known = stamps[rows[places[places >= 0]]]
    if len(rows) < len(files):
        return se3.interpolate(T_any_camera, known, stamps)
    return poses_near(T_any_camera, known, stamps, path)


def _T_camera_lidar(drive: Path, cameras: CalibrationFile, number: str) -> FloatArray | None:
    """LiDAR to the rectified camera; None where ``calib_velo_to_cam.txt`` is missing."""
    path = drive.parent / kitti.VELO_TO_CAM
    if not path.exists():
        logger.warning("no %s: neither LiDAR nor GPS/INS has extrinsics to the camera", path)
        return None
    T_rect0_cam0 = se3.make(cameras.matrix("R_rect_00", (3, 3)), np.zeros(3))
    T_cam0_lidar = CalibrationFile(path).transform("R", "T")
    T_camera_lidar: FloatArray = (
        cameras.T_camera_cam0(f"P_rect_{number}") @ T_rect0_cam0 @ T_cam0_lidar
    )
    return T_camera_lidar


def _oxts_poses(
    drive: Path,
    files: NumberedFiles,
    stamps: FloatArray,
    image_times: FloatArray | None,
    T_camera_lidar: FloatArray | None,
) -> FloatArray | None:
    """``T_world_camera`` from the GPS/INS; None where it or its calibration is missing."""
    folder, path = drive / "oxts" / "data", drive.parent / kitti.IMU_TO_VELO
    if T_camera_lidar is None or not folder.is_dir():
        return None
    if not path.exists():
        logger.warning("no %s: the drive has no reference poses", path)
        return None
    packets = _readers(kitti.read_packet, folder, "*.txt", files)
    if not packets.keys() >= set(files.rows):
        raise SequenceError(
            f"{folder} has {len(packets)} packets for {len(files.paths)} images: restore what is missing, or remove "
            f"oxts to run without a reference"
        )
    known = np.array([row for row in range(len(files)) if row in packets])
    ages_s = np.zeros(len(known))
    numbered = by_number(sorted(folder.glob("*.txt")))
    packet_times = _dates(drive / "oxts" / "timestamps.txt", numbered)
    if image_times is not None and packet_times is not None:
        ages_s = image_times[known] - packet_times[known + files.first - numbered.first]
    content = np.array([packets[row]() for row in known.tolist()])
    T_camera_imu = T_camera_lidar @ CalibrationFile(path).transform("R", "T")
    T_world_camera = T_world_imu(content, ages_s) @ se3.invert(T_camera_imu)
    if len(known) < len(files):
        T_world_camera = se3.interpolate(T_world_camera, stamps[known], stamps)
    return T_world_camera


def T_world_imu(packets: FloatArray, ages_s: FloatArray) -> FloatArray:
    """Poses of the IMU ``(N, 4, 4)``, metres, in a Mercator projection scaled at the first latitude.

    The IMU looks forward along x, left along y, up along z; the world is east, north, up.

    Args:
        packets: rows of OXTS, ``(N, 30)``.
        ages_s: how long before its image each packet was taken, seconds, ``(N,)``, negative for one taken
            after it; the pose is extrapolated to the image with the packet's velocity and angular rate.
            Packets and images differ by up to 14 ms, which at 40 km/h is 15 cm.
    """
    latitude = np.deg2rad(packets[:, 0])
    longitude = np.deg2rad(packets[:, 1])
    altitude = packets[:, 2]
    scale = np.cos(latitude[0])
    east = scale * _EARTH_RADIUS_M * longitude
    north = scale * _EARTH_RADIUS_M * np.log(np.tan(np.pi / 4 + latitude / 2))
    velocity = packets[:, [kitti.VELOCITY_EAST, kitti.VELOCITY_NORTH, kitti.VELOCITY_UP]]
    positions = np.column_stack([east, north, altitude]) + velocity * ages_s[:, None]
    turn = Rotation.from_rotvec(packets[:, _RATES] * ages_s[:, None])
    R_world_imu = Rotation.from_euler("ZYX", packets[:, [5, 4, 3]]) * turn
    return se3.make(R_world_imu.as_matrix(), positions)


def _readers(
    read: Callable[[Path], FloatArray], folder: Path, pattern: str, files: NumberedFiles
) -> ArrayReaders:
    """Readers of the files of a folder by frame, by the numbers of the images."""
    paths = (path for path in folder.glob(pattern) if path.stem.isdecimal())
    return {int(path.stem) - files.first: partial(read, path) for path in paths}


def _distance_to_mesh(path: Path) -> Callable[[FloatArray], FloatArray] | None:
    """Distances from points ``(M, 3)``, in the frame of the first true pose, to a mesh, which is read when first asked.

    None without a file.
    """
    if not path.is_file():
        return None

    @functools.cache
    def scene() -> object:
        mesh = read_ply(path)
        if mesh.triangles is None:
            raise SequenceError(f"{path} has no triangles: simulate again, or remove it")
        return scene_of(mesh.points.astype(np.float32), mesh.triangles.astype(np.uint32))

    return lambda points: distances(scene(), points)


def _find_odometry(path: Path, asked: Asked) -> Openers:
    """The sequences of a root, or the one whose own folder is given."""
    root, where = kitti.find_odometry_root(path), path.absolute()
    if root is not None:
        names = root.names()
        if asked.name and asked.name not in names and (root.sequences / asked.name).is_dir():
            names.append(asked.name)  # for the error about what it lacks
    elif where.parent.name == "sequences" and kitti.odometry_camera(path) is not None:
        root, names = kitti.find_odometry_root(where.parent), [where.name]
    if root is None:
        return {}
    return {name: partial(_open_odometry, root, name, asked.camera) for name in names}


def _find_raw(path: Path, asked: Asked) -> Openers:
    return {
        name: partial(_open_raw, drive, asked.camera)
        for name, drive in kitti.find_drives(path).items()
    }


LOADERS = (
    Loader("KITTI odometry", "sequences/NN/image_2", _find_odometry),
    Loader("KITTI raw", "DATE_drive_NNNN_sync", _find_raw),
)
