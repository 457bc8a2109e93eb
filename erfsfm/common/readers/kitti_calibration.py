"""KITTI's calibration files: rows of ``KEY: numbers`` and what their matrices mean.

Geiger et al. 2013, "Vision meets robotics: the KITTI dataset". A rectified camera i projects points of
rectified camera 0 by ``P_i = K [I | t]``, so ``x_i = x_0 + t`` with ``t = K^-1 p4``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.files import read_text
from erfsfm.common.readers.pinhole import Pinhole, require_plausible

FloatArray = NDArray[np.float64]

ODOMETRY_CALIBRATION = "calib.txt"
CAM_TO_CAM, VELO_TO_CAM, IMU_TO_VELO = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt"
_SHIPPED = {
    ODOMETRY_CALIBRATION: "with the odometry images (data_odometry_calib.zip); copy it there",
    **dict.fromkeys((CAM_TO_CAM, VELO_TO_CAM, IMU_TO_VELO), "as DATE_calib.zip; copy it beside the drives"),
}
ASPECT_TOLERANCE = 0.01
CAMERA_HEIGHT_M = 1.65  # of the car's cameras above the road
_SCALE_TOLERANCE = 0.15  # of a principal point from the middle, along both axes


class CalibrationFile:
    """The numeric rows of one calibration file."""

    def __init__(self, path: Path) -> None:
        """Read a file.

        Raises:
            DataError: it is missing or cannot be read, or two rows of one name differ.
        """
        self.path = path
        if not path.is_file():
            shipped = _SHIPPED.get(path.name)
            raise DataError(f"no {path.name} in {path.parent}" + (f": KITTI ships it {shipped}" if shipped else ""))
        try:
            text = read_text(path)
        except (OSError, UnicodeDecodeError) as error:
            raise DataError(f"cannot read calibration {path}: {error}") from error
        rows = [line.partition(":") for line in text.splitlines() if line.strip()]
        self._rows = {key.strip(): value.split() for key, _, value in rows}
        doubled = [key.strip() for key, _, value in rows if self._rows[key.strip()] != value.split()]
        if doubled:
            raise DataError(f"{path} has two rows {doubled[0]} with other numbers: keep the right one")

    def __contains__(self, key: str) -> bool:
        """Whether the file has a row of this name."""
        return key in self._rows

    def matrix(self, key: str, shape: tuple[int, ...]) -> FloatArray:
        """The numbers of a row, row-major.

        Raises:
            DataError: the row is missing, has another count of numbers, or holds something else.
        """
        count = int(np.prod(shape))
        words = self._rows.get(key)
        if words is None:
            raise DataError(f"no row {key} in {self.path}: found {', '.join(self._rows) or 'nothing'}")
        try:
            numbers = np.array([float(word) for word in words])
        except ValueError as error:
            raise DataError(f"{self.path} row {key}: {error}; it needs {count} numbers") from error
        if len(numbers) != count or not np.isfinite(numbers).all():
            raise DataError(
                f"{self.path} row {key} has {len(numbers)} numbers: it needs {count} finite ones; restore the file"
            )
        return numbers.reshape(shape)

    def transform(self, R_key: str, t_key: str) -> FloatArray:
        """``(4, 4)`` from a row of nine numbers and one of three."""
        return _rigid(self.matrix(R_key, (3, 3)), self.matrix(t_key, (3,)))

    def T_camera_cam0(self, key: str) -> FloatArray:
        """Rectified camera 0 to the rectified camera of projection matrix ``key``, ``(4, 4)``, metres."""
        P = self.matrix(key, (3, 4))
        if not abs(np.linalg.det(P[:, :3])) > 0:
            raise DataError(f"{self.path} row {key} is no K [I | t] with positive focal lengths; restore the file")
        t_camera_cam0: FloatArray = np.linalg.inv(P[:, :3]) @ P[:, 3]
        return _rigid(np.eye(3), t_camera_cam0)

    def pinhole(self, key: str, width: int, height: int) -> Pinhole:
        """The camera of a projection matrix of ``calib.txt``, for images of the given size.

        The file has no image size: it is that of the images where the principal point is near their middle.

        Raises:
            DataError: no pinhole, an impossible one, or one of images of another size.
        """
        camera = self._pinhole(key, width, height)
        scales = 2 * (camera.cx + 0.5) / width, 2 * (camera.cy + 0.5) / height
        both_off = all(abs(scale - 1) > _SCALE_TOLERANCE for scale in scales)
        if not all(0.5 < scale < 1.5 for scale in scales) or (
            both_off and abs(scales[0] / scales[1] - 1) < _SCALE_TOLERANCE
        ):
            raise DataError(
                f"{self.path}: the principal point ({camera.cx:g}, {camera.cy:g}) in row {key} is far from the middle "
                f"of {width}x{height} images: calibration and images are of different sizes; scale the calibration as "
                f"the images were"
            )
        require_plausible(camera, f"{self.path} row {key}")
        return camera

    def rectified_pinhole(self, camera: str, width: int, height: int) -> Pinhole:
        """A camera (``"02"``) of ``calib_cam_to_cam.txt``, for images resized to the given size.

        Raises:
            DataError: no pinhole, an impossible one, or one of images of another shape.
        """
        size = self.matrix(f"S_rect_{camera}", (2,))
        if not (size > 0).all():
            raise DataError(f"{self.path} row S_rect_{camera} must hold a positive width and height; restore the file")
        full_width, full_height = int(size[0]), int(size[1])
        if abs(width * full_height / (height * full_width) - 1) > ASPECT_TOLERANCE:
            raise DataError(
                f"the images are {width}x{height}, but camera {camera} in {self.path} is {full_width}x{full_height}: "
                f"the images were cropped or are of another camera"
            )
        full = self._pinhole(f"P_rect_{camera}", full_width, full_height)
        require_plausible(full, f"{self.path} row P_rect_{camera}")
        return full.resized(width, height)

    def _pinhole(self, key: str, width: int, height: int) -> Pinhole:
        P = self.matrix(key, (3, 4))
        fx, fy, cx, cy = (float(value) for value in (P[0, 0], P[1, 1], P[0, 2], P[1, 2]))
        skew_free = P[0, 1] == P[1, 0] == P[2, 0] == P[2, 1] == 0 and P[2, 2] == 1
        if not (fx > 0 and fy > 0 and skew_free):
            raise DataError(f"{self.path} row {key} is no K [I | t] with positive focal lengths; restore the file")
        if not (0 < cx < width and 0 < cy < height):
            raise DataError(
                f"{self.path} row {key} has its principal point at ({cx:g}, {cy:g}), outside the "
                f"{width}x{height} images: calibration and images are of different sizes; scale the calibration as the "
                f"images were"
            )
        return Pinhole(width, height, fx, fy, cx, cy)


def _rigid(R_a_b: FloatArray, t_a_b: FloatArray) -> FloatArray:
    T_a_b = np.eye(4)
    T_a_b[:3, :3], T_a_b[:3, 3] = R_a_b, t_a_b
    return T_a_b
