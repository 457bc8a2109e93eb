"""Options of an export, and how they are read from text."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray
from slam.runtime.errors import RunError

# from a camera's x right, y down, z ahead
R_UP_WORLDS: dict[str, FloatArray] = {
    "y-down": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),  # x right, y ahead, z up
    "y-up": np.diag([1.0, -1.0, -1.0]),  # x right, y up, z backwards
}
DEFAULT_RESOLUTION = 0.1
_LATITUDE, _LONGITUDE, _HEADING = 90.0, 180.0, 360.0


@dataclass(frozen=True)
class Crop:
    """A box in the world of the run: ``low`` and ``high`` ``(3,)``."""

    low: FloatArray
    high: FloatArray

    def contains(self, points: FloatArray) -> NDArray[np.bool_]:
        """Which points ``(P, 3)`` lie inside, ``(P,)`` bool."""
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=1))


@dataclass(frozen=True)
class Origin:
    """Where the first camera stands on the earth, and where it looks, clockwise from north."""

    latitude_deg: float
    longitude_deg: float
    heading_deg: float


@dataclass(frozen=True)
class ExportOptions:
    """What to do with a part of a run on the way out; None leaves it as it is.

    Attributes:
        crop: keep what is inside.
        voxel: thin a cloud to one point a cube of this side, or resample a mesh so.
        triangles: simplify a mesh to so many.
        resolution: side of a raster's or grid's cell.
        origin: makes a raster a map with north up, and writes GeoTIFF.
        dataset: where the images of the run are now.
        points: at most so many of a COLMAP model.
    """

    crop: Crop | None = None
    voxel: float | None = None
    triangles: int | None = None
    resolution: float | None = None
    origin: Origin | None = None
    dataset: Path | None = None
    points: int | None = None


def parse_crop(text: str | None) -> Crop | None:
    """Read ``x0,x1,y0,y1,z0,z1``; ``inf`` and ``-inf`` leave a side open.

    Raises:
        RunError: it is no such box.
    """
    if text is None:
        return None
    values = _numbers(text, 6, "--crop", "x0,x1,y0,y1,z0,z1, such as -10,10,-5,2,0,50", lambda x: not math.isnan(x))
    low, high = np.array(values[0::2]), np.array(values[1::2])
    if not (low < high).all():
        raise RunError(f"--crop {text} is empty: x0 must be less than x1, y0 less than y1, z0 less than z1")
    return Crop(low, high)


def parse_origin(text: str | None) -> Origin | None:
    """Read ``LAT,LON,HEADING`` in degrees.

    Raises:
        RunError: it is no such place.
    """
    if text is None:
        return None
    wanted = "LAT,LON,HEADING in degrees, heading clockwise from north, such as 49.0110,8.4160,90"
    latitude, longitude, heading = _numbers(text, 3, "--origin", wanted, math.isfinite)
    if abs(latitude) > _LATITUDE or abs(longitude) > _LONGITUDE or abs(heading) > _HEADING:
        raise RunError(f"--origin {text} is no place on the earth: write {wanted}")
    return Origin(latitude, longitude, heading)


def _numbers(text: str, count: int, option: str, wanted: str, allowed: Callable[[float], bool]) -> list[float]:
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(allowed, values)):
        raise RunError(f"{option} {text!r} is not understood: write {wanted}")
    return values
