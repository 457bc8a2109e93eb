"""The map of a finished run as the report shows it: a thinned surface, the camera's path, and where it is seen from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.formats.ply import Ply, map_ply
from slam.geometry.se3 import FloatArray, apply, invert
from slam.results.folder import RunFolder
from slam.runtime.imports import import_open3d
from slam.runtime.run_files import MAP_MESH

_CHUNK = 1_000_000  # triangles at a time
_COARSER = 1.15  # vertices of one surface do not all meet in its cells
_FINER = 2  # triangles that quadric errors choose from, as a multiple of those that stay
_MOST_TRIANGLES = 1_000_000  # that are thinned by quadric errors; a larger mesh is clustered first
_CANDIDATES = 9
_SEEN_WITHIN = 40.0
_NEAR_PERCENT = 10
_HALF_FIELD = np.array([0.9, 0.5])  # tangents, of width and height


@dataclass(frozen=True)
class MapMesh:
    """Vertices ``(V, 3)`` in the world, y down, their RGB colours ``(V, 3)`` uint8, and triangles ``(T, 3)``."""

    points: FloatArray
    colours: NDArray[np.uint8]
    triangles: NDArray[np.int64]


@dataclass(frozen=True)
class MapView:
    """A surface, the poses of the camera ``(N, 4, 4)`` in its world, the ``frame`` from which it is seen first, and how
    far ``ahead`` of it the map is near."""

    mesh: MapMesh
    T_world_camera: FloatArray
    frame: int
    ahead: float


def map_view(folder: RunFolder, triangles: int) -> MapView | None:
    """The map with at most about so many triangles; None without ``map_mesh.ply``, or where none are wanted.

    It is seen from that one of nine frames, evenly spread over the path, before which most vertices lie.

    Raises:
        RunError: the mesh is damaged.
    """
    trajectory = folder.trajectory("optimised")
    if not triangles or trajectory is None or not (folder.path / MAP_MESH).is_file():
        return None
    mesh = thinned_mesh(folder.path / MAP_MESH, triangles)
    poses = trajectory.T_world_camera
    frames = np.unique(np.linspace(0, len(poses) - 1, _CANDIDATES + 2)[1:-1].round().astype(int)).tolist()
    depths = [_depths(mesh.points, poses[frame]) for frame in frames]
    best = int(np.argmax([np.count_nonzero(z < _SEEN_WITHIN) for z in depths]))
    ahead = float(np.percentile(depths[best], _NEAR_PERCENT)) if len(depths[best]) else _SEEN_WITHIN
    return MapView(mesh, poses, frames[best], ahead)


def thinned_mesh(path: Path, triangles: int) -> MapMesh:
    """A ``map_mesh.ply`` with at most about so many triangles: vertices of cells put together, then quadric errors.

    Raises:
        RunError: it is no mesh that can be read.
    """
    vertices, faces = map_ply(path)
    if len(faces) > max(_MOST_TRIANGLES, _FINER * triangles):
        mesh = _clustered(vertices, faces["vertices"], _FINER * triangles)
    else:
        ply = Ply(vertices)
        mesh = MapMesh(ply.points, ply.colours_or_grey, faces["vertices"].astype(np.int64))
    if len(mesh.triangles) <= triangles:
        return mesh
    o3d = import_open3d()
    vector = o3d.utility.Vector3dVector
    whole = o3d.geometry.TriangleMesh(vector(mesh.points), o3d.utility.Vector3iVector(mesh.triangles.astype(np.int32)))
    whole.vertex_colors = vector(mesh.colours / 255.0)
    few = whole.simplify_quadric_decimation(triangles).remove_degenerate_triangles().remove_unreferenced_vertices()
    colours = np.rint(255.0 * np.clip(np.asarray(few.vertex_colors), 0.0, 1.0)).astype(np.uint8)
    return MapMesh(np.asarray(few.vertices), colours, np.asarray(few.triangles).astype(np.int64))


def _clustered(vertices: NDArray[np.void], corners: NDArray[Any], triangles: int) -> MapMesh:
    """One vertex a cell: the mean of those inside, and of their colours. Fields are read one by one, to save memory."""
    some = Ply(vertices[corners[:: max(len(corners) // _CHUNK, 1)].ravel()]).points.reshape(-1, 3, 3)
    edges = some[:, 1:] - some[:, :1]
    area = 0.5 * float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).mean()) * len(corners)
    cell = _COARSER * float(np.sqrt(2.0 * area / triangles)) or 1.0
    keys = np.zeros(len(vertices), np.int64)  # of cells, 21 bits an axis
    for axis in "xyz":
        values = vertices[axis].astype(np.float64)
        keys = (keys << 21) | np.minimum((values - values.min()) / cell, 2**21 - 1).astype(np.int64)
    unique, cells = np.unique(keys, return_inverse=True)
    counts = np.bincount(cells)

    def means(fields: tuple[str, ...]) -> FloatArray:
        return np.stack([np.bincount(cells, vertices[field], len(unique)) / counts for field in fields], axis=1)

    pieces = (cells[corners[start : start + _CHUNK]] for start in range(0, len(corners), _CHUNK))
    flat = [piece[(np.diff(np.sort(piece, axis=1), axis=1) > 0).all(axis=1)] for piece in pieces]
    colours = np.rint(means(("red", "green", "blue"))).astype(np.uint8)
    return MapMesh(means(("x", "y", "z")), colours, np.unique(np.concatenate(flat), axis=0).astype(np.int64))


def _depths(points: FloatArray, T_world_camera: FloatArray) -> FloatArray:
    """Depths of the points ``(P, 3)`` that lie in the field of view."""
    X = apply(invert(T_world_camera), points)
    inside = (X[:, 2] > 0) & (abs(X[:, :2]) < _HALF_FIELD * X[:, 2:]).all(axis=1)
    return np.asarray(X[inside, 2])
