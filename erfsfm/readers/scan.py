"""LiDAR scans as points; KITTI's Velodyne files hold four float32 a point: x, y, z and reflectance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from erfsfm.errors import DataError

VELODYNE_COLUMNS = 4


def read_velodyne(path: Path, columns: int = VELODYNE_COLUMNS) -> NDArray[np.float64]:
    """The points of a file of float32 ``(P, 3)``, metres, in the LiDAR frame; x, y, z are the first of ``columns``.

    Points that are not finite are left out.

    Raises:
        DataError: it cannot be read, is cut off, or has no finite point.
    """
    try:
        values = np.fromfile(path, dtype=np.float32)
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}); restore the scan or remove the folder") from error
    if len(values) == 0 or len(values) % columns:
        raise DataError(f"{path} is no Velodyne scan: wanted {columns} float32 a point; got {values.nbytes} bytes")
    points = values.reshape(-1, columns)[:, :3].astype(np.float64)
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise DataError(f"{path} has no point with finite coordinates; restore the scan or remove it")
    return points[finite]
