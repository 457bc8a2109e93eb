"""KITTI's calibration files: rows of ``KEY: numbers`` and what their matrices mean.

Geiger et al. 2013, "Vision meets robotics: the KITTI dataset". A rectified camera i projects points of
rectified camera 0 by ``P_i = K [I | t]``, so ``x_i = x_0 + t`` with ``t = K^-1 p4``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam import se3
from slam.errors import SequenceError
from slam.frames import Intrinsics
from slam.se3 import FloatArray


class CalibrationFile:
    """The numeric rows of one calibration file."""

    def __init__(self, path: Path) -> None:
        """Read a file.

        Raises:
            SequenceError: if it cannot be read.
        """
        self.path = path
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise SequenceError(f"cannot read calibration {path}: {error}") from error
        rows = (line.partition(":") for line in text.splitlines() if line.strip())
        self._rows = {key.strip(): value.split() for key, _, value in rows}

    def __contains__(self, key: str) -> bool:
        """Whether the file has a row of this name."""
        return key in self._rows

    def matrix(self, key: str, shape: tuple[int, ...]) -> FloatArray:
        """The numbers of a row, row-major.

        Raises:
            SequenceError: if the row is missing, has another count of numbers, or holds something else.
        """
        count = int(np.prod(shape))
        words = self._rows.get(key)
        if words is None:
            raise SequenceError(f"no row {key} in {self.path}: found {', '.join(self._rows) or 'nothing'}")
        try:
            numbers = np.array([float(word) for word in words])
        except ValueError as error:
            raise SequenceError(f"{self.path} row {key}: {error}; it needs {count} numbers") from error
        if len(numbers) != count or not np.isfinite(numbers).all():
            raise SequenceError(
                f"{self.path} row {key} has {len(numbers)} numbers: it needs {count} finite ones; restore the file"
            )
        return numbers.reshape(shape)

    def transform(self, R_key: str, t_key: str) -> FloatArray:
        """``(4, 4)`` from a row of nine numbers and one of three."""
        return se3.make(self.matrix(R_key, (3, 3)), self.matrix(t_key, (3,)))

    def intrinsics(self, key: str, width: int, height: int) -> Intrinsics:
        """The pinhole of a projection matrix, for images of the given size.

        Raises:
            SequenceError: if the matrix is no pinhole, or not one of such images.
        """
        P = self.matrix(key, (3, 4))
        fx, fy, cx, cy = P[0, 0], P[1, 1], P[0, 2], P[1, 2]
        skew_free = P[0, 1] == P[1, 0] == P[2, 0] == P[2, 1] == 0 and P[2, 2] == 1
        if not (fx > 0 and fy > 0 and skew_free):
            raise SequenceError(f"{self.path} row {key} is no K [I | t] with positive focal lengths; restore the file")
        if not (0 < cx < width and 0 < cy < height):
            raise SequenceError(
                f"{self.path} row {key} has its principal point at ({cx:g}, {cy:g}), outside the "
                f"{width}x{height} images: scale the calibration as the images were"
            )
        return Intrinsics(width, height, float(fx), float(fy), float(cx), float(cy))

    def T_camera_cam0(self, key: str) -> FloatArray:
        """Rectified camera 0 to the rectified camera of projection matrix ``key``, ``(4, 4)``, metres."""
        P = self.matrix(key, (3, 4))
        t_camera_cam0: FloatArray = np.linalg.inv(P[:, :3]) @ P[:, 3]
        return se3.make(np.eye(3), t_camera_cam0)


def moved_to_camera(T_any_cam0: FloatArray, T_camera_cam0: FloatArray) -> FloatArray:
    """Poses ``T_any_camera`` ``(N, 4, 4)`` of a camera that is rigidly mounted to camera 0."""
    T_any_camera: FloatArray = T_any_cam0 @ se3.invert(T_camera_cam0)
    return T_any_camera
