"""Packets of KITTI's GPS/INS (``oxts/dataformat.txt``): 30 numbers, one text file a frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.files import read_text

FloatArray = NDArray[np.float64]

VELOCITY_NORTH, VELOCITY_EAST, VELOCITY_UP = 6, 7, 10  # columns, m/s
_COLUMNS = 30


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
