"""KITTI raw drives: ``DATE/DATE_drive_NNNN_sync`` with its calibration one level up."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from erfsfm.common.files import read_text
from erfsfm.common.readers.camera_file import CameraFile
from erfsfm.common.readers.images import has_images, list_images
from erfsfm.common.readers.kitti_calibration import (
    CAM_TO_CAM,
    CAMERA_HEIGHT_M,
    IMU_TO_VELO,
    VELO_TO_CAM,
    CalibrationFile,
)
from erfsfm.common.readers.kitti_drives import ODOMETRY_DRIVES, RAW_CAMERAS, drive_name, find_drives
from erfsfm.common.readers.kitti_sensors import read_packet
from erfsfm.common.readers.numbering import NumberedFiles, by_number
from slam.frames import Intrinsics
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import explicit_camera, mount_beside
from slam.sequences.depth_maps import depth_maps_in
from slam.sequences.images import ImageFiles
from slam.sequences.kitti import oxts
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.recording import (
    RecordedSequence,
    Source,
    fallback_stamps,
    require_stamps,
    scans_in,
)

logger = logging.getLogger(__name__)

_DEPTH_MAPS = "proj_depth/groundtruth"  # of KITTI's depth benchmark
_EPOCH = np.datetime64("2011-01-01", "ns")


def open_kitti_raw(drive: Path, asked: Path | None) -> RecordedSequence:
    """Open one synced and rectified drive.

    The calibration is scaled to the images' true size. The camera that was ``asked`` for, if any, replaces it.

    Raises:
        SequenceError, DataError: if images, calibration or stamps are missing or do not match.
    """
    drive = drive.absolute()
    number = next((c for c in RAW_CAMERAS if has_images(drive / f"image_{c}" / "data")), None)
    if number is None:
        looked = ", ".join(f"image_{c}/data" for c in RAW_CAMERAS)
        raise SequenceError(f"no images in {drive}: looked for png or jpg in {looked}; copy the drive again")
    files = by_number(list_images(drive / f"image_{number}" / "data"))
    stored = ImageFiles(files)
    cameras = CalibrationFile(drive.parent / CAM_TO_CAM)
    pinhole = cameras.rectified_pinhole(number, stored.width, stored.height)
    height_m, readout_s = mount_beside(pinhole, CAMERA_HEIGHT_M, drive, drive.parent, drive.parent.parent)
    camera: CameraFile | Intrinsics = replace(Intrinsics.of(pinhole), readout_s=readout_s)
    if asked is not None:
        camera, height_m = explicit_camera(asked, stored), CAMERA_HEIGHT_M
    times_path = drive / f"image_{number}" / "timestamps.txt"
    image_times = _times(times_path, files)
    stamps = fallback_stamps(times_path, len(files)) if image_times is None else image_times - image_times[0]
    T_camera_lidar = _T_camera_lidar(drive, cameras, number)
    name = drive_name(drive.name)
    return RecordedSequence(
        name=name,
        images=stored,
        camera=camera,
        stamps=stamps,
        sources=tuple(source.shifted(files.first) for source in drive_sources(name)),
        T_any_camera=_true_poses(drive, files, stamps, image_times, T_camera_lidar),
        usual_height_m=height_m,
        T_camera_lidar=T_camera_lidar,
        scans=scans_in(drive / "velodyne_points/data", files),
        depth_maps=depth_maps_in(drive / _DEPTH_MAPS / f"image_{number}", files),
    )


def drive_sources(name: str) -> tuple[Source, ...]:
    """A drive's names in the leak record: its own, and that of the odometry sequence made from it."""
    own = Source(f"kitti_raw/{name}")
    cut = ((sequence, first, stop) for sequence, (drive, first, stop) in ODOMETRY_DRIVES.items() if drive == name)
    return own, *(Source(f"kitti_odometry/{s}", first=-first, length=stop - first) for s, first, stop in cut)


def _times(path: Path, files: NumberedFiles) -> FloatArray | None:
    """Seconds since KITTI's year began, one for each row of files, or None without ``path``."""
    if not path.exists():
        return None
    try:
        stamps = np.array(read_text(path).split("\n"), dtype="datetime64[ns]")
    except (OSError, ValueError) as error:
        raise SequenceError(f"{path} must hold a date and a time a row: {error}") from error
    stamps = stamps[~np.isnat(stamps)]
    seconds: FloatArray = (stamps - _EPOCH).astype(np.float64) * 1e-9
    return require_stamps(seconds, path, files)


def _T_camera_lidar(drive: Path, cameras: CalibrationFile, number: str) -> FloatArray | None:
    """LiDAR to the rectified camera; None where ``calib_velo_to_cam.txt`` is missing."""
    path = drive.parent / VELO_TO_CAM
    if not path.exists():
        logger.warning("no %s: neither LiDAR nor GPS/INS has extrinsics to the camera", path)
        return None
    T_rect0_cam0 = se3.make(cameras.matrix("R_rect_00", (3, 3)), np.zeros(3))
    T_cam0_lidar = CalibrationFile(path).transform("R", "T")
    T_camera_lidar: FloatArray = cameras.T_camera_cam0(f"P_rect_{number}") @ T_rect0_cam0 @ T_cam0_lidar
    return T_camera_lidar


def _true_poses(
    drive: Path,
    files: NumberedFiles,
    stamps: FloatArray,
    image_times: FloatArray | None,
    T_camera_lidar: FloatArray | None,
) -> FloatArray | None:
    """``T_world_camera`` from the GPS/INS; None where it or its calibration is missing."""
    folder, path = drive / "oxts" / "data", drive.parent / IMU_TO_VELO
    if T_camera_lidar is None or not folder.is_dir():
        return None
    if not path.exists():
        logger.warning("no %s: the drive has no reference poses", path)
        return None
    found = sorted(folder.glob("*.txt"))
    packets = by_number(found) if found else None
    paths = {} if packets is None else dict(zip((packets.first + row for row in packets.rows), packets.paths))
    rows = range(len(files)) if all(files.first + row in paths for row in range(len(files))) else files.rows
    if packets is None or not all(files.first + row in paths for row in rows):
        raise SequenceError(
            f"{folder} has {len(paths)} packets for {len(files.paths)} images: restore what is missing, or remove "
            f"oxts to run without a reference"
        )
    known = np.array(rows)
    ages_s = np.zeros(len(known))
    packet_times = _times(drive / "oxts" / "timestamps.txt", packets)
    if image_times is not None and packet_times is not None:
        ages_s = image_times[known] - packet_times[known + files.first - packets.first]
    content = np.array([read_packet(paths[files.first + row]) for row in rows])
    T_camera_imu = T_camera_lidar @ CalibrationFile(path).transform("R", "T")
    T_world_camera = oxts.T_world_imu(content, ages_s) @ se3.invert(T_camera_imu)
    if len(known) < len(files):
        T_world_camera = se3.interpolate(T_world_camera, stamps[known], stamps)
    return T_world_camera


def _find(path: Path, asked: Asked) -> dict[str, Opener]:
    return {name: partial(open_kitti_raw, drive, asked.camera) for name, drive in find_drives(path).items()}


LOADER = Loader("KITTI raw", "DATE_drive_NNNN_sync", _find)
