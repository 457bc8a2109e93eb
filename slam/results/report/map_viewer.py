"""The map in the report: its mesh packed for the page, with the script that shows it by WebGL."""

from __future__ import annotations

import base64
import gzip
import json
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

from slam.geometry.se3 import FloatArray
from slam.results.report.map_mesh import MapMesh
from slam.results.report.map_picture import BACKGROUND, FIELD_OF_VIEW_DEG

_MOST_OF_PATH = 2000
_AHEAD = 12.0  # what the view turns about, before the driver
_Y_UP = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class MapViewer:
    """Parts of the page: ``about`` as JSON, ``mesh`` and the library ``three`` as base64 of gzip, ``script``."""

    about: str
    mesh: str
    three: str
    script: str


def map_viewer(mesh: MapMesh, T_world_camera: FloatArray, seat: int) -> MapViewer:
    """Pack a mesh with the drive through it.

    Args:
        mesh: of the map, y down; in the page y is up.
        T_world_camera: poses of the drive, ``(N, 4, 4)``.
        seat: the frame from which the map is seen first.
    """
    first, corners = _by_first_use(mesh)
    points = mesh.points[first] * _Y_UP
    low = points.min(axis=0)
    step = np.maximum((points.max(axis=0) - low) / 65535.0, 1e-9)
    content = np.rint((points - low) / step).astype("<u2").tobytes() + mesh.colours[first].tobytes()
    padding = -len(content) % 4
    content += bytes(padding) + np.diff(corners.ravel(), prepend=0).astype("<i4").tobytes()
    rows = np.linspace(0, len(T_world_camera) - 1, min(len(T_world_camera), _MOST_OF_PATH)).round().astype(int)
    position = T_world_camera[seat, :3, 3]
    ahead = position + _AHEAD * T_world_camera[seat, :3, 2]
    about = {
        "vertices": len(points),
        "triangles": len(corners),
        "padding": padding,
        "low": low.tolist(),
        "step": step.tolist(),
        "path": (T_world_camera[rows, :3, 3] * _Y_UP).round(3).ravel().tolist(),
        "seat": (position * _Y_UP).tolist(),
        "ahead": (ahead * _Y_UP).tolist(),
        "field_of_view_deg": FIELD_OF_VIEW_DEG,
        "background": "#" + bytes(BACKGROUND).hex(),
    }
    script, three = (files("slam.results.report") / "viewer" / name for name in ("viewer.js", "three.min.js"))
    return MapViewer(json.dumps(about), _packed(content), _packed(three.read_bytes()), script.read_text("utf-8"))


def _by_first_use(mesh: MapMesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices in the order of the triangles, and the triangles by their new numbers, which then differ little."""
    triangles = mesh.triangles[np.lexsort(np.sort(mesh.triangles, axis=1).T[::-1])]
    used, first, inverse = np.unique(triangles, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty(len(used), dtype=np.int64)
    number[order] = np.arange(len(used))
    return used[order], number[inverse].reshape(-1, 3)


def _packed(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode("ascii")
