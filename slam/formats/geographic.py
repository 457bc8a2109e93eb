"""Paths on the earth as GeoJSON (RFC 7946)."""

from __future__ import annotations

import json
from pathlib import Path

from slam.geometry.se3 import FloatArray
from slam.runtime.errors import RunError
from slam.runtime.storage.files import write_atomically


def write_geojson(path: Path, name: str, places: FloatArray, stamps: FloatArray) -> None:
    """Write a line through ``places`` ``(N, 3)`` (latitude, longitude, metres) with ``stamps`` ``(N,)``, atomically."""
    # longitude, latitude, height to a millimetre
    coordinates = [[round(float(east), 9), round(float(north), 9), round(float(up), 3)] for north, east, up in places]
    line = {"type": "LineString", "coordinates": coordinates}
    feature = {
        "type": "Feature",
        "properties": {"name": name, "stamps": [round(float(stamp), 6) for stamp in stamps]},
        "geometry": line,
    }
    text = json.dumps({"type": "FeatureCollection", "features": [feature]}, allow_nan=False)
    write_atomically(path, lambda file: file.write_text(text + "\n", encoding="utf-8"), RunError)
