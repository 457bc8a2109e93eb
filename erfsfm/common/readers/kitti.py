"""KITTI's names, folders and files (Geiger et al. 2013, "Vision meets robotics: the KITTI dataset").

Raw drives lie in ``ROOT/2011_09_26/2011_09_26_drive_0013_sync/{image_02,oxts,...}``, odometry sequences in
``ROOT/sequences/NN/{image_2,calib.txt,times.txt}`` with ``ROOT/poses/NN.txt``. Calibrations are rows ``KEY: numbers``.
A rectified camera i projects points of rectified camera 0 by ``P_i = K [I | t]``, so ``x_i = x_0 + t`` with
``t = K^-1 p4``. Packets of the GPS/INS (``oxts/dataformat.txt``) are 30 numbers in a text file, scans four float32 a
point: x, y, z and reflectance.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.files import read_bytes, read_text
from erfsfm.common.readers.camera_file import Pinhole, require_plausible
from erfsfm.common.readers.images import has_images, natural_key

FloatArray = NDArray[np.float64]

ODOMETRY_CAMERAS = (2, 3, 0, 1)  # left and right colour, left and right grey
RAW_CAMERAS = ("02", "03", "00", "01")
SIMULATION_FILE = "simulation.json"
_DRIVE = re.compile(r"(?P<name>\d{4}_\d\d_\d\d_drive_\d{4})_(?P<kind>sync|extract)")
_DATE = re.compile(r"\d{4}_\d\d_\d\d")

# odometry sequence -> the raw drive it was cut from, its first and one past its last frame there
# (development kit, readme of the odometry benchmark)
ODOMETRY_DRIVES = {
    "00": ("2011_10_03_drive_0027", 0, 4541),
    "01": ("2011_10_03_drive_0042", 0, 1101),
    "02": ("2011_10_03_drive_0034", 0, 4661),
    "03": ("2011_09_26_drive_0067", 0, 801),
    "04": ("2011_09_30_drive_0016", 0, 271),
    "05": ("2011_09_30_drive_0018", 0, 2761),
    "06": ("2011_09_30_drive_0020", 0, 1101),
    "07": ("2011_09_30_drive_0027", 0, 1101),
    "08": ("2011_09_30_drive_0028", 1100, 5171),
    "09": ("2011_09_30_drive_0033", 0, 1591),
    "10": ("2011_09_30_drive_0034", 0, 1201),
}

ODOMETRY_CALIBRATION = "calib.txt"
CAM_TO_CAM = "calib_cam_to_cam.txt"
VELO_TO_CAM = "calib_velo_to_cam.txt"
IMU_TO_VELO = "calib_imu_to_velo.txt"
_SHIPPED = {
    ODOMETRY_CALIBRATION: "with the odometry images (data_odometry_calib.zip); copy it there",
    **dict.fromkeys(
        (CAM_TO_CAM, VELO_TO_CAM, IMU_TO_VELO), "as DATE_calib.zip; copy it beside the drives"
    ),
}
ASPECT_TOLERANCE = 0.01
CAMERA_HEIGHT_M = 1.65  # of the car's cameras above the road
_SCALE_TOLERANCE = 0.15  # of a principal point from the middle, along both axes

# packets of the GPS/INS
_COLUMNS = 30
VELOCITY_NORTH = 6  # columns, m/s
VELOCITY_EAST = 7
VELOCITY_UP = 10

# scans
VELODYNE_COLUMNS = 4
_FARTHEST_M = 1e4
_MOST_BYTES = 2**28  # 16 million points of four numbers


@dataclass(frozen=True)
class OdometryRoot:
    """An odometry root; ``base`` is the folder with ``sequences`` and ``poses``."""

    base: Path
    sequences: Path

    def folders(self) -> list[Path]:
        """The folder of every sequence, in natural order."""
        return sorted(filter(Path.is_dir, self.sequences.iterdir()), key=natural_key)

    def names(self) -> list[str]:
        """Sequences that have images."""
        return [folder.name for folder in self.folders() if odometry_camera(folder) is not None]

    def simulation_seed(self) -> int | None:
        """The seed of a simulated world; None of a real root.

        Raises:
            DataError: the file of a simulated world holds no seed.
        """
        path = self.base / SIMULATION_FILE
        if not path.is_file():
            return None
        try:
            return int(json.loads(path.read_text(encoding="utf-8"))["seed"])
        except (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            raise DataError(
                f"{path} must hold the simulation's seed: {error!r}; simulate again"
            ) from error

    def recording_name(self, sequence: str) -> str:
        """A sequence in the leak record: the simulated world by its seed, or the KITTI sequence by its number."""
        seed = self.simulation_seed()
        return f"kitti_odometry/{sequence}" if seed is None else f"simulated/{seed}"


def find_odometry_root(dataset: Path) -> OdometryRoot | None:
    """Recognise a root: the folder above ``sequences`` or ``dataset/sequences``, or ``sequences`` itself."""
    for base in (dataset, dataset / "dataset"):
        if (base / "sequences").is_dir():
            return OdometryRoot(base, base / "sequences")
    if dataset.is_dir() and dataset.absolute().name == "sequences":
        return OdometryRoot(dataset.absolute().parent, dataset)
    return None


def odometry_camera(folder: Path) -> int | None:
    """The camera of a sequence to use: colour before grey, left before right; None without any images."""
    for camera in ODOMETRY_CAMERAS:
        if has_images(folder / f"image_{camera}"):
            return camera
    return None


def find_drives(dataset: Path) -> dict[str, Path]:
    """Rectified drives by name (``2011_09_26_drive_0013``): the folder itself, those in it, or those in its dates.

    Raises:
        DataError: the folder is an unrectified drive.
    """
    own = _DRIVE.fullmatch(dataset.absolute().name)
    if own is not None:
        if own["kind"] == "extract":
            raise DataError(
                f"{dataset} is not rectified: download the drive as synced+rectified (_sync)"
            )
        return {own["name"]: dataset}
    if not dataset.is_dir():
        return {}
    dates = [path for path in dataset.iterdir() if _DATE.fullmatch(path.name) and path.is_dir()]
    drives = {}
    for folder in (dataset, *dates):
        for path in folder.iterdir():
            match = _DRIVE.fullmatch(path.name)
            if match is not None and match["kind"] == "sync" and path.is_dir():
                drives[match["name"]] = path
    return dict(sorted(drives.items()))


def drive_name(text: str) -> str:
    """The canonical name of a drive that a user writes with or without its date folder and ``_sync``."""
    return Path(text).name.removesuffix("_sync")


class CalibrationFile:
    """The numeric rows of one calibration file."""

    def __init__(self, path: Path) -> None:
        """Read a file.

        Raises:
            DataError: there is no such file, or it cannot be read.
        """
        self.path = path
        if not path.is_file():
            shipped = _SHIPPED.get(path.name)
            raise DataError(
                f"no {path.name} in {path.parent}"
                + (f": KITTI ships it {shipped}" if shipped else "")
            )
        try:
            text = read_text(path)
        except (OSError, UnicodeDecodeError) as error:
            raise DataError(f"cannot read calibration {path}: {error}") from error
        self._rows: dict[str, list[str]] = {}
        for line in text.splitlines():
            if line.strip():
                key, _, value = line.partition(":")
                self._rows[key.strip()] = value.split()

    def __contains__(self, key: str) -> bool:
        """Whether the file has a row of this name."""
        return key in self._rows

    def matrix(self, key: str, shape: tuple[int, ...]) -> FloatArray:
        """The numbers of a row, row-major.

        Raises:
            DataError: there is no such row, or it holds other than that many finite numbers.
        """
        count = int(np.prod(shape))
        words = self._rows.get(key)
        if words is None:
            raise DataError(
                f"no row {key} in {self.path}: found {', '.join(self._rows) or 'nothing'}"
            )
        try:
            numbers = np.array(list(map(float, words)))
        except ValueError as error:
            raise DataError(f"{self.path} row {key}: {error}; it needs {count} numbers") from error
        if len(numbers) != count or not np.isfinite(numbers).all():
            raise DataError(
                f"{self.path} row {key} has {len(numbers)} numbers: it needs {count} finite ones"
            )
        return numbers.reshape(shape)

    def transform(self, R_key: str, t_key: str) -> FloatArray:
        """``(4, 4)`` from a row of nine numbers and one of three."""
        return _rigid(self.matrix(R_key, (3, 3)), self.matrix(t_key, (3,)))

    def T_camera_cam0(self, key: str) -> FloatArray:
        """Rectified camera 0 to the rectified camera of projection matrix ``key``, ``(4, 4)``, metres.

        Raises:
            DataError: the row is missing or is no projection matrix.
        """
        P = self.matrix(key, (3, 4))
        if not abs(np.linalg.det(P[:, :3])) > 0:
            raise DataError(
                f"{self.path} row {key} is no K [I | t] with positive focal lengths; restore the file"
            )
        t_camera_cam0: FloatArray = np.linalg.inv(P[:, :3]) @ P[:, 3]
        return _rigid(np.eye(3), t_camera_cam0)

    def pinhole(self, key: str, width: int, height: int) -> Pinhole:
        """The camera of a projection matrix of ``calib.txt``, for images of the given size.

        The file has no image size: it is that of the images where the principal point is near their middle.

        Raises:
            DataError: the row is no projection matrix, or one of images of another size.
        """
        camera = self._pinhole(key, width, height)
        scales = 2 * (camera.cx + 0.5) / width, 2 * (camera.cy + 0.5) / height
        both_off = min(abs(scale - 1) for scale in scales) > _SCALE_TOLERANCE
        if not 0.5 < min(scales) <= max(scales) < 1.5 or (
            both_off and abs(scales[0] / scales[1] - 1) < _SCALE_TOLERANCE
        ):
            raise DataError(
                f"{self.path}: the principal point ({camera.cx:g}, {camera.cy:g}) in row {key} is far from the middle "
                f"of {width}x{height} images: they are of different sizes; scale the calibration as the images were"
            )
        require_plausible(camera, f"{self.path} row {key}")
        return camera

    def rectified_pinhole(self, camera: str, width: int, height: int) -> Pinhole:
        """A camera (``"02"``) of ``calib_cam_to_cam.txt``, for images resized to the given size.

        Raises:
            DataError: rows are missing or damaged, or the images have another shape than the
                camera.
        """
        size = self.matrix(f"S_rect_{camera}", (2,))
        if not (size > 0).all():
            raise DataError(
                f"{self.path} row S_rect_{camera} must hold a positive width and height; restore the file"
            )
        full_width, full_height = int(size[0]), int(size[1])
        if abs(width * full_height / (height * full_width) - 1) > ASPECT_TOLERANCE:
            raise DataError(
                f"{self.path} is of another camera, or images were cropped to {width}x{height}"
            )
        full = self._pinhole(f"P_rect_{camera}", full_width, full_height)
        require_plausible(full, f"{self.path} row P_rect_{camera}")
        return full.resized(width, height)

    def _pinhole(self, key: str, width: int, height: int) -> Pinhole:
        P = self.matrix(key, (3, 4))
        fx, fy, cx, cy = map(float, (P[0, 0], P[1, 1], P[0, 2], P[1, 2]))
        skew_free = P[0, 1] == P[1, 0] == P[2, 0] == P[2, 1] == 0 and P[2, 2] == 1
        if not (fx > 0 and fy > 0 and skew_free):
            raise DataError(
                f"{self.path} row {key} is no K [I | t] with positive focal lengths; restore the file"
            )
        return Pinhole(width, height, fx, fy, cx, cy)


def _rigid(R_a_b: FloatArray, t_a_b: FloatArray) -> FloatArray:
    T_a_b = np.eye(4)
    T_a_b[:3, :3], T_a_b[:3, 3] = R_a_b, t_a_b
    return T_a_b


def read_packet(path: Path) -> FloatArray:
    """One packet ``(30,)``.

    Raises:
        DataError: it cannot be read, or does not hold 30 finite numbers.
    """
    try:
        row = list(map(float, read_text(path).split()))
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read OXTS packet {path}: {error}") from error
    if len(row) != _COLUMNS or not np.isfinite(row).all():
        raise DataError(
            f"OXTS packet {path} has {len(row)} numbers, not {_COLUMNS} finite ones: copy it again"
        )
    return np.array(row)


def velocity(oxts: Path, frame: int) -> FloatArray:
    """Of the car in m/s: north, east, up ``(3,)``, from the packet of a frame in ``oxts/data``.

    Raises:
        DataError: the packet is missing or damaged.
    """
    path = oxts / f"{frame:010d}.txt"
    if not path.is_file():
        raise DataError(
            f"{path} is missing: the speed of the car comes from a packet of the GPS/IMU a frame"
        )
    return read_packet(path)[[VELOCITY_NORTH, VELOCITY_EAST, VELOCITY_UP]]


def read_velodyne(path: Path, columns: int = VELODYNE_COLUMNS) -> NDArray[np.float64]:
    """The points of a file of float32 ``(P, 3)``, metres, in the LiDAR frame; x, y, z are the first of ``columns``.

    Points at the LiDAR's own place or beyond 10 km, which it cannot measure, are left out.

    Raises:
        DataError: the file cannot be read, is no scan, or has no measured point.
    """
    try:
        content = read_bytes(path, _MOST_BYTES)
    except OSError as error:
        raise DataError(
            f"{path} cannot be read ({error.strerror}); restore the scan or remove the folder"
        ) from error
    values = np.frombuffer(content[: len(content) // 4 * 4], dtype=np.float32)
    if len(values) == 0 or len(values) % columns:
        raise DataError(
            f"{path} is no Velodyne scan: wanted {columns} float32 a point; got {len(content)} bytes"
        )
    points = values.reshape(-1, columns)[:, :3].astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        distances = np.linalg.norm(points, axis=1)
    measured = (distances > 0) & (distances < _FARTHEST_M)
    if not measured.any():
        raise DataError(
            f"{path} has no point at a distance that a LiDAR measures; restore the scan or remove it"
        )
    return points[measured]
