"""Paths on the earth as GeoJSON (RFC 7946) and KML."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

from slam.geometry.se3 import FloatArray
from slam.runtime.errors import RunError
from slam.runtime.storage.files import write_atomically

_KML = "http://www.opengis.net/kml/2.2"


def write_geojson(path: Path, name: str, places: FloatArray, stamps: FloatArray) -> None:
    """Write a line through ``places`` ``(N, 3)`` (latitude, longitude, metres) with ``stamps`` ``(N,)``, atomically."""
    line = {"type": "LineString", "coordinates": _coordinates(places)}
    feature = {
        "type": "Feature",
        "properties": {"name": name, "stamps": [round(float(stamp), 6) for stamp in stamps]},
        "geometry": line,
    }
    text = json.dumps({"type": "FeatureCollection", "features": [feature]}, allow_nan=False)
    write_atomically(path, lambda file: file.write_text(text + "\n", encoding="utf-8"), RunError)


def write_kml(path: Path, name: str, places: FloatArray) -> None:
    """Write the same line as KML, atomically; heights are drawn on the ground."""
    root = ElementTree.Element("kml", xmlns=_KML)
    mark = ElementTree.SubElement(ElementTree.SubElement(root, "Document"), "Placemark")
    ElementTree.SubElement(mark, "name").text = name
    line = ElementTree.SubElement(mark, "LineString")
    ElementTree.SubElement(line, "tessellate").text = "1"
    words = (",".join(map(repr, place)) for place in _coordinates(places))
    ElementTree.SubElement(line, "coordinates").text = " ".join(words)
    content = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    write_atomically(path, lambda file: file.write_bytes(content), RunError)


def _coordinates(places: FloatArray) -> list[list[float]]:
    """Longitude, latitude, height to a millimetre, as both formats order them."""
    return [[round(float(east), 9), round(float(north), 9), round(float(up), 3)] for north, east, up in places]
