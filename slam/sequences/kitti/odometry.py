"""KITTI odometry roots, real or simulated.

``sequences/NN/{image_2/NNNNNN.png, calib.txt, times.txt}`` and ``poses/NN.txt``, which are of camera 0.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.errors import SequenceError
from slam.frames import Intrinsics
from slam.se3 import FloatArray
from slam.sequences.camera_file import CAMERA_FILE, CameraFile, read_camera_file
from slam.sequences.images import ImageFiles, has_images, list_images, natural_key, require_numbered
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
from slam.trajectory import read_trajectory

CAMERAS = (2, 3, 0, 1)
SIMULATION_FILE = "simulation.json"


@dataclass(frozen=True)
class OdometryRoot:
    """Where a root keeps its sequences; ``base`` is the folder with ``sequences`` and ``poses``."""

    base: Path
    sequences: Path

    def names(self) -> list[str]:
        """Sequences that have images."""
        folders = sorted((p for p in self.sequences.iterdir() if p.is_dir()), key=natural_key)
        return [folder.name for folder in folders if camera_of(folder) is not None]


def find_root(dataset: Path) -> OdometryRoot | None:
    """Recognise a root: the folder above ``sequences`` or ``dataset/sequences``, or ``sequences`` itself."""
    for base in (dataset, dataset / "dataset"):
        if (base / "sequences").is_dir():
            return OdometryRoot(base, base / "sequences")
    if dataset.absolute().name == "sequences":
        return OdometryRoot(dataset.absolute().parent, dataset)
    return None


def camera_of(folder: Path) -> int | None:
    """The camera to use: left colour, right colour, left grey or right grey; None without any images."""
    return next((camera for camera in CAMERAS if has_images(folder / f"image_{camera}")), None)


def open_kitti_odometry(root: OdometryRoot, name: str, camera: CameraFile | None) -> Recording:
    """Open one sequence of an odometry root.

    ``camera``, where given, takes the place of the root's calibration and of its camera height.

    Raises:
        SequenceError: if images, ``calib.txt``, ``times.txt`` or the poses are missing or do not match.
    """
    folder = root.sequences / name
    number = camera_of(folder)
    if number is None:
        raise SequenceError(_no_images(folder))
    paths = list_images(folder / f"image_{number}")
    require_numbered(paths)
    files = ImageFiles(paths)
    calibration = _calibration(folder)
    T_camera_cam0 = calibration.T_camera_cam0(f"P{number}")
    images: ImageSource = files
    intrinsics: Intrinsics
    if camera is None:
        intrinsics = calibration.intrinsics(f"P{number}", files.width, files.height)
    else:
        images, intrinsics = calibrated(files, camera, str(folder))
    return Recording(
        name=name,
        images=images,
        intrinsics=intrinsics,
        stamps=_stamps(folder / "times.txt", len(paths)),
        sources=(_source(root, name),),
        reference=_reference(root.base / "poses" / f"{name}.txt", len(paths), T_camera_cam0),
        camera_height_m=_camera_height(root, camera),
        T_camera_lidar=_T_camera_lidar(calibration, T_camera_cam0),
        scans={int(p.stem): p for p in (folder / "velodyne").glob("*.bin") if p.stem.isdecimal()},
    )


def _no_images(folder: Path) -> str:
    found = ", ".join(sorted(p.name for p in folder.iterdir())) if folder.is_dir() else "no such folder"
    looked = ", ".join(f"image_{camera}" for camera in CAMERAS)
    return f"no images in {folder}: looked for png or jpg in {looked}; found {found or 'an empty folder'}"


def _calibration(folder: Path) -> CalibrationFile:
    path = folder / "calib.txt"
    if not path.is_file():
        raise SequenceError(
            f"no calib.txt in {folder}: KITTI ships it with the odometry images (data_odometry_calib.zip); "
            f"copy it there"
        )
    return CalibrationFile(path)


def _stamps(path: Path, frames: int) -> FloatArray:
    if not path.is_file():
        return fallback_stamps(path, frames)
    try:
        stamps = np.array([float(line) for line in path.read_text(encoding="utf-8").split()])
    except (OSError, ValueError) as error:
        raise SequenceError(f"{path} must hold one time in seconds a row: {error}") from error
    return require_stamps(stamps, path, frames)


def _reference(path: Path, frames: int, T_camera_cam0: FloatArray) -> FloatArray | None:
    """Poses of the camera in use from poses of camera 0; None where the root has no poses."""
    if not path.is_file():
        return None
    T_world_cam0 = read_trajectory(path, format="kitti").T_world_camera
    if len(T_world_cam0) != frames:
        raise SequenceError(
            f"{path} has {len(T_world_cam0)} poses for {frames} images: restore the missing images, or cut "
            f"the poses to match, or remove the file to run without a reference"
        )
    return rebased(moved_to_camera(T_world_cam0, T_camera_cam0))


def _camera_height(root: OdometryRoot, camera: CameraFile | None) -> float | None:
    if camera is None and (root.base / CAMERA_FILE).is_file():
        camera = read_camera_file(root.base / CAMERA_FILE)
    return KITTI_CAMERA_HEIGHT_M if camera is None else camera.height_or(KITTI_CAMERA_HEIGHT_M)


def _T_camera_lidar(calibration: CalibrationFile, T_camera_cam0: FloatArray) -> FloatArray | None:
    """LiDAR to the camera in use; some calibrations write ``Tr``, others ``Tr_velo_to_cam``."""
    key = next((key for key in ("Tr", "Tr_velo_to_cam") if key in calibration), None)
    if key is None:
        return None
    T_cam0_lidar = np.vstack([calibration.matrix(key, (3, 4)), [0.0, 0.0, 0.0, 1.0]])
    T_camera_lidar: FloatArray = T_camera_cam0 @ T_cam0_lidar
    return T_camera_lidar


def _source(root: OdometryRoot, name: str) -> Source:
    """The simulated world by its seed, or the KITTI sequence by its number."""
    path = root.base / SIMULATION_FILE
    if not path.is_file():
        return Source(f"kitti_odometry/{name}")
    try:
        seed = int(json.loads(path.read_text(encoding="utf-8"))["seed"])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise SequenceError(f"{path} must hold the simulation's seed: {error!r}; simulate again") from error
    return Source(f"simulated/{seed}", first=None)
