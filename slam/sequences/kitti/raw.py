"""KITTI raw drives: ``DATE/DATE_drive_NNNN_sync`` with its calibration one level up."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np

from slam import se3
from slam.errors import SequenceError
from slam.frames import Intrinsics
from slam.se3 import FloatArray
from slam.sequences.camera_file import CAMERA_FILE, CameraFile, read_camera_file
from slam.sequences.images import ImageFiles, has_images, list_images, require_numbered
from slam.sequences.kitti import oxts
from slam.sequences.kitti.calibration import CalibrationFile, moved_to_camera
from slam.sequences.recording import (
    KITTI_CAMERA_HEIGHT_M,
    ImageSource,
    Recording,
    Source,
    fallback_stamps,
    rebased,
    require_stamps,
)
from slam.sequences.undistortion import calibrated

logger = logging.getLogger(__name__)

CAMERAS = ("02", "03", "00", "01")
_DRIVE = re.compile(r"(\d{4}_\d\d_\d\d_drive_\d{4})_(sync|extract)")
_EPOCH = np.datetime64("2011-01-01", "ns")
_DATE = re.compile(r"\d{4}_\d\d_\d\d")

ODOMETRY_OF_DRIVE: dict[str, tuple[str, int, int]] = {
    "2011_10_03_drive_0027": ("00", 0, 4540),
    "2011_10_03_drive_0042": ("01", 0, 1100),
    "2011_10_03_drive_0034": ("02", 0, 4660),
    "2011_09_26_drive_0067": ("03", 0, 800),
    "2011_09_30_drive_0016": ("04", 0, 270),
    "2011_09_30_drive_0018": ("05", 0, 2760),
    "2011_09_30_drive_0020": ("06", 0, 1100),
    "2011_09_30_drive_0027": ("07", 0, 1100),
    "2011_09_30_drive_0028": ("08", 1100, 5170),
    "2011_09_30_drive_0033": ("09", 0, 1590),
    "2011_09_30_drive_0034": ("10", 0, 1200),
}
"""Odometry sequence made from a drive, with the drive's first and last frame in it (odometry devkit)."""


def find_drives(dataset: Path) -> dict[str, Path]:
    """Drives by name (``2011_09_26_drive_0013``): the folder itself, those in it, or those in its dates.

    Raises:
        SequenceError: if the folder is an unrectified (``_extract``) drive.
    """
    own = _DRIVE.fullmatch(dataset.absolute().name)
    if own is not None:
        if own.group(2) == "extract":
            raise SequenceError(f"{dataset} is not rectified: download the synced+rectified drive (_sync)")
        return {own.group(1): dataset}
    if not dataset.is_dir():
        return {}
    dates = [p for p in dataset.iterdir() if _DATE.fullmatch(p.name) and p.is_dir()]
    drives = {}
    for folder in [dataset, *dates]:
        for path in folder.iterdir():
            match = _DRIVE.fullmatch(path.name)
            if match is not None and match.group(2) == "sync" and path.is_dir():
                drives[match.group(1)] = path
    return dict(sorted(drives.items()))


def drive_name(text: str) -> str:
    """A drive as the user writes it (with its date folder, with ``_sync``, or without) as we name it."""
    return Path(text).name.removesuffix("_sync")


def open_kitti_raw(drive: Path, camera: CameraFile | None) -> Recording:
    """Open one synced and rectified drive.

    The calibration is scaled to the images' true size. ``camera``, where given, takes its place.

    Raises:
        SequenceError: if images, calibration or stamps are missing or do not match.
    """
    drive = drive.absolute()
    number = next((c for c in CAMERAS if has_images(drive / f"image_{c}" / "data")), None)
    if number is None:
        looked = ", ".join(f"image_{c}/data" for c in CAMERAS)
        raise SequenceError(f"no images in {drive}: looked for png or jpg in {looked}; copy the drive again")
    paths = list_images(drive / f"image_{number}" / "data")
    require_numbered(paths)
    images: ImageSource = ImageFiles(paths)
    cameras = _calibration(drive.parent / "calib_cam_to_cam.txt")
    intrinsics = scaled_intrinsics(cameras, number, images.width, images.height)
    if camera is not None:
        images, intrinsics = calibrated(images, camera, str(drive))
    times_path = drive / f"image_{number}" / "timestamps.txt"
    image_times = _times(times_path, len(paths))
    T_camera_lidar = _T_camera_lidar(drive, cameras, number)
    name = drive_name(drive.name)
    return Recording(
        name=name,
        images=images,
        intrinsics=intrinsics,
        stamps=fallback_stamps(times_path, len(paths)) if image_times is None else image_times - image_times[0],
        sources=drive_sources(name),
        reference=_reference(drive, len(paths), image_times, T_camera_lidar),
        camera_height_m=_camera_height(drive, camera),
        T_camera_lidar=T_camera_lidar,
        scans={int(p.stem): p for p in (drive / "velodyne_points/data").glob("*.bin") if p.stem.isdecimal()},
    )


def scaled_intrinsics(cameras: CalibrationFile, number: str, width: int, height: int) -> Intrinsics:
    """A rectified camera's pinhole for images resized from ``S_rect`` to the given size."""
    size = cameras.matrix(f"S_rect_{number}", (2,))
    return cameras.intrinsics(f"P_rect_{number}", int(size[0]), int(size[1])).resized(width, height)


def drive_sources(name: str) -> tuple[Source, ...]:
    """A drive's names in the leak record: its own, and that of the odometry sequence made from it."""
    own = Source(f"kitti_raw/{name}")
    if name not in ODOMETRY_OF_DRIVE:
        return (own,)
    sequence, first, last = ODOMETRY_OF_DRIVE[name]
    return own, Source(f"kitti_odometry/{sequence}", first=-first, length=last - first + 1)


def _calibration(path: Path) -> CalibrationFile:
    if not path.is_file():
        raise SequenceError(
            f"no {path.name} in {path.parent}: KITTI ships it as DATE_calib.zip; copy it beside the drives"
        )
    return CalibrationFile(path)


def _times(path: Path, frames: int) -> FloatArray | None:
    """Seconds since KITTI's year began, ``(frames,)``, or None without the file."""
    if not path.is_file():
        return None
    try:
        stamps = np.array(path.read_text(encoding="utf-8").split("\n"), dtype="datetime64[ns]")
    except (OSError, ValueError) as error:
        raise SequenceError(f"{path} must hold a date and a time a row: {error}") from error
    stamps = stamps[~np.isnat(stamps)]
    seconds: FloatArray = (stamps - _EPOCH).astype(np.float64) * 1e-9
    return require_stamps(seconds, path, frames)


def _T_camera_lidar(drive: Path, cameras: CalibrationFile, number: str) -> FloatArray | None:
    """LiDAR to the rectified camera; None where ``calib_velo_to_cam.txt`` is missing."""
    path = drive.parent / "calib_velo_to_cam.txt"
    if not path.is_file():
        logger.warning("no %s: neither LiDAR nor GPS/INS can be related to the camera", path)
        return None
    T_rect0_cam0 = se3.make(cameras.matrix("R_rect_00", (3, 3)), np.zeros(3))
    T_cam0_lidar = CalibrationFile(path).transform("R", "T")
    T_camera_lidar: FloatArray = cameras.T_camera_cam0(f"P_rect_{number}") @ T_rect0_cam0 @ T_cam0_lidar
    return T_camera_lidar


def _reference(
    drive: Path, frames: int, image_times: FloatArray | None, T_camera_lidar: FloatArray | None
) -> FloatArray | None:
    """``T_world_camera`` from the GPS/INS; None where it or its calibration is missing."""
    folder, path = drive / "oxts" / "data", drive.parent / "calib_imu_to_velo.txt"
    if T_camera_lidar is None or not folder.is_dir():
        return None
    if not path.is_file():
        logger.warning("no %s: the drive has no reference poses", path)
        return None
    packets = oxts.read_packets(folder)
    if len(packets) != frames:
        raise SequenceError(
            f"{folder} has {len(packets)} packets for {frames} images: restore what is missing, or remove "
            f"oxts to run without a reference"
        )
    packet_times = _times(drive / "oxts" / "timestamps.txt", frames)
    ages_s = np.zeros(frames)
    if image_times is not None and packet_times is not None:
        ages_s = image_times - packet_times
    T_camera_imu = T_camera_lidar @ CalibrationFile(path).transform("R", "T")
    return rebased(moved_to_camera(oxts.T_world_imu(packets, ages_s), T_camera_imu))


def _camera_height(drive: Path, camera: CameraFile | None) -> float | None:
    """1.65 m unless a camera file, given or in the drive, its date or the root, says otherwise."""
    beside = (folder / CAMERA_FILE for folder in (drive, drive.parent, drive.parent.parent))
    found = next((path for path in beside if path.is_file()), None)
    if camera is None and found is not None:
        camera = read_camera_file(found)
    return KITTI_CAMERA_HEIGHT_M if camera is None else camera.height_or(KITTI_CAMERA_HEIGHT_M)
