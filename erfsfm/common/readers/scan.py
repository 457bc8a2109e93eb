"""LiDAR scans as points; KITTI's Velodyne files hold four float32 a point: x, y, z and reflectance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.files import read_bytes

VELODYNE_COLUMNS = 4
_FARTHEST_M = 1e4
_MOST_BYTES = 2**28  # 16 million points of four numbers


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
