"""Places on the earth: GPS tracks, and a local frame east, north, up on the ellipsoid of WGS 84."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.geometry import se3
from slam.geometry.se3 import FloatArray

_A = 6378137.0  # half axes, metres
_B = 6356752.314245179
_E2 = 1.0 - (_B / _A) ** 2
_E2_SECOND = (_A / _B) ** 2 - 1.0


@dataclass(frozen=True)
class GpsTrack:
    """Fixes of a GPS receiver.

    Attributes:
        stamps: seconds ``(M,)``, increasing.
        places: latitude and longitude in degrees, height over the ellipsoid or the sea in metres, ``(M, 3)``.
        dilution: of precision, factors on the usual sigmas of a fix ``(M,)``.
    """

    stamps: FloatArray
    places: FloatArray
    dilution: FloatArray


class LocalFrame:
    """Axes east, north, up in metres, with their origin at a place."""

    def __init__(self, place: FloatArray) -> None:
        """At a place ``(3,)``: latitude and longitude in degrees, height in metres."""
        latitude, longitude = np.deg2rad(place[:2])
        north_of, east_of = np.sin(latitude), np.sin(longitude)
        along, level = np.cos(latitude), np.cos(longitude)
        R_earth_local = np.array(
            [
                [-east_of, -north_of * level, along * level],
                [level, -north_of * east_of, along * east_of],
                [0.0, along, north_of],
            ]
        )
        self._T_earth_local = se3.make(R_earth_local, _earth_centred(place[None])[0])

    def points(self, places: FloatArray) -> FloatArray:
        """Points ``(N, 3)`` east, north, up of places ``(N, 3)``."""
        return se3.apply(se3.invert(self._T_earth_local), _earth_centred(places))

    def places(self, points: FloatArray) -> FloatArray:
        """Places ``(N, 3)`` of points ``(N, 3)``: the inverse of `points`, by Bowring's formula."""
        x, y, z = se3.apply(self._T_earth_local, points).T
        radius = np.hypot(x, y)
        parametric = np.arctan2(z * _A, radius * _B)
        latitude = np.arctan2(
            z + _E2_SECOND * _B * np.sin(parametric) ** 3, radius - _E2 * _A * np.cos(parametric) ** 3
        )
        normal = _A / np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)
        height = radius * np.cos(latitude) + z * np.sin(latitude) - normal * (1.0 - _E2 * np.sin(latitude) ** 2)
        return np.column_stack([np.rad2deg(latitude), np.rad2deg(np.arctan2(y, x)), height])


def _earth_centred(places: FloatArray) -> FloatArray:
    """Places ``(N, 3)`` in the axes of the earth, metres."""
    latitude, longitude = np.deg2rad(places[:, :2]).T
    normal = _A / np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)
    radius = (normal + places[:, 2]) * np.cos(latitude)
    z = (normal * (1.0 - _E2) + places[:, 2]) * np.sin(latitude)
    return np.column_stack([radius * np.cos(longitude), radius * np.sin(longitude), z])
