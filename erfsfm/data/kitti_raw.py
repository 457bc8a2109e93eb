"""KITTI raw drives: their folders, calibration and GPS/IMU (Geiger et al. 2013).

Layout: ``ROOT/2011_09_26/2011_09_26_drive_0013_sync/{image_02,image_03,oxts}/data``, calibration in the folder of the
date. Images may be smaller than the original: the calibration follows them.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from erfsfm.data.images import image_files, image_size, require_numbered
from erfsfm.data.recordings import Recording
from erfsfm.errors import DataError
from erfsfm.geometry.camera import Camera

FloatArray = NDArray[np.float64]

CALIBRATION = "calib_cam_to_cam.txt"
ASPECT_TOLERANCE = 0.01
CAMERA_HEIGHT_M = 1.65  # of the car's cameras above the road
_DRIVE = re.compile(r"(?P<name>\d{4}_\d\d_\d\d_drive_\d{4})_(?P<kind>sync|extract)")
_COLOUR, _GREY = ("02", "03"), ("00", "01")
_VELOCITY = [6, 7, 10]  # north, east, up in m/s (oxts/dataformat.txt)


def find_drives(root: Path) -> list[Path]:
    """Rectified drives: the folder itself, those in it, or those in its dates; sorted.

    Raises:
        DataError: the folder is a drive that is not rectified.
    """
    own = _DRIVE.fullmatch(root.absolute().name)
    if own is not None and own["kind"] == "extract":
        raise DataError(f"{root} is not rectified: download the drive as synced+rectified (_sync)")
    if own is not None or not root.is_dir():
        return [root] if own is not None else []
    return sorted(path for pattern in ("*_sync", "????_??_??/*_sync") for path in root.glob(pattern) if _is_drive(path))


def open_drive(drive: Path) -> list[Recording]:
    """Its colour cameras, else the first of its grey ones; none where it has no images.

    Raises:
        DataError: frames or calibration are missing, or the images are of another shape than the camera.
    """
    drive = drive.absolute()
    match = _DRIVE.fullmatch(drive.name)
    assert match is not None, drive
    folders = {camera: drive / f"image_{camera}" / "data" for camera in (*_COLOUR, *_GREY)}
    present = [camera for camera, folder in folders.items() if folder.is_dir() and image_files(folder)]
    recordings = []
    for camera in [camera for camera in present if camera in _COLOUR] or present[:1]:
        images = image_files(folders[camera])
        require_numbered(images)
        oxts = drive / "oxts" / "data"
        recordings.append(
            Recording(
                f"kitti_raw/{match['name']}",
                images,
                _camera(drive.parent / CALIBRATION, camera, images[0]),
                oxts=oxts if oxts.is_dir() else None,
            )
        )
    return recordings


def read_calibration(path: Path) -> dict[str, FloatArray]:
    """The rows of numbers of a calibration file.

    Raises:
        DataError: there is no such file.
    """
    if not path.is_file():
        raise DataError(f"{path} is missing: KITTI's calibration lies in the folder of the date")
    rows = {}
    for key, _, text in (line.partition(":") for line in path.read_text().splitlines()):
        try:
            rows[key] = np.array([float(word) for word in text.split()])
        except ValueError:
            continue  # the time of calibration
    return rows


def velocity(oxts: Path, frame: int) -> FloatArray:
    """Of the car in m/s: north, east, up ``(3,)``, from the GPS/IMU's packet of a frame.

    Raises:
        DataError: the packet is missing or malformed.
    """
    path = oxts / f"{frame:010d}.txt"
    if not path.is_file():
        raise DataError(f"{path} is missing: the speed of the car comes from a packet of the GPS/IMU a frame")
    words = path.read_text().split()
    try:
        return np.array([float(words[column]) for column in _VELOCITY])
    except (ValueError, IndexError) as error:
        raise DataError(f"{path} must hold the 30 numbers of a GPS/IMU packet; copy it again") from error


def _is_drive(path: Path) -> bool:
    return path.is_dir() and _DRIVE.fullmatch(path.name) is not None


def _camera(calibration: Path, camera: str, image: Path) -> Camera:
    """The rectified camera of images resized from its original size."""
    rows = read_calibration(calibration)
    try:
        full_width, full_height = (int(number) for number in rows[f"S_rect_{camera}"])
        P = rows[f"P_rect_{camera}"].reshape(3, 4)
    except (KeyError, ValueError) as error:
        raise DataError(
            f"{calibration} has no valid rows S_rect_{camera} (2 numbers) and P_rect_{camera} (12)"
        ) from error
    if not (P[0, 0] > 0 and P[1, 1] > 0 and full_width > 0 and full_height > 0):
        raise DataError(f"{calibration}: size and focal lengths of camera {camera} must be positive")
    height, width = image_size(image)
    if abs(width * full_height / (height * full_width) - 1) > ASPECT_TOLERANCE:
        raise DataError(
            f"{image} is {width} x {height}, but camera {camera} in {calibration} is {full_width} x {full_height}: the "
            "images were cropped or are of another camera"
        )
    full = Camera(full_width, full_height, float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2]))
    return full.resized(width, height)
