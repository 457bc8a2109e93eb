"""KITTI's other sensors: packets of the GPS/INS (``oxts/dataformat.txt``), 30 numbers in one text file, and scans.

Velodyne files hold four float32 a point: x, y, z and reflectance.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.files import read_bytes, read_text

FloatArray = NDArray[np.float64]

VELOCITY_NORTH, VELOCITY_EAST, VELOCITY_UP = 6, 7, 10  # columns, m/s
_COLUMNS = 30
VELODYNE_COLUMNS = 4
_FARTHEST_M = 1e4
_MOST_BYTES = 2**28  # 16 million points of four numbers


def read_packet(path: Path) -> FloatArray:
    """One packet ``(30,)``.

    Raises:
        DataError: it cannot be read, or has not 30 numbers.
    """
    try:
        row = [float(word) for word in read_text(path).split()]
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read OXTS packet {path}: {error}") from error
    if len(row) != _COLUMNS or not np.isfinite(row).all():
        raise DataError(f"OXTS packet {path} has {len(row)} numbers, not {_COLUMNS} finite ones: copy it again")
    return np.array(row)


def velocity(oxts: Path, frame: int) -> FloatArray:
    """Of the car in m/s: north, east, up ``(3,)``, from the packet of a frame in ``oxts/data``.

    Raises:
        DataError: the packet is missing or malformed.
    """
    path = oxts / f"{frame:010d}.txt"
    if not path.is_file():
        raise DataError(f"{path} is missing: the speed of the car comes from a packet of the GPS/IMU a frame")
    return read_packet(path)[[VELOCITY_NORTH, VELOCITY_EAST, VELOCITY_UP]]


def read_velodyne(path: Path, columns: int = VELODYNE_COLUMNS) -> NDArray[np.float64]:
    """The points of a file of float32 ``(P, 3)``, metres, in the LiDAR frame; x, y, z are the first of ``columns``.

    Points at the LiDAR's own place or beyond 10 km, which it cannot measure, are left out.

    Raises:
        DataError: it cannot be read, is cut off, or has no other points.
    """
    try:
        content = read_bytes(path, _MOST_BYTES)
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}); restore the scan or remove the folder") from error
    values = np.frombuffer(content[: len(content) // 4 * 4], dtype=np.float32)
    if len(values) == 0 or len(values) % columns:
        raise DataError(f"{path} is no Velodyne scan: wanted {columns} float32 a point; got {len(content)} bytes")
    points = values.reshape(-1, columns)[:, :3].astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        distances = np.linalg.norm(points, axis=1)
    measured = (distances > 0) & (distances < _FARTHEST_M)
    if not measured.any():
        raise DataError(f"{path} has no point at a distance that a LiDAR measures; restore the scan or remove it")
    return np.asarray(points[measured])
