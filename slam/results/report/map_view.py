"""The map of a finished run as the report shows it: a thinned surface, the camera's path, and where it is seen from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray, apply, invert
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError
from slam.runtime.files import MAP_MESH
from slam.runtime.imports import import_open3d

_TRIANGLES = 60_000  # that a browser turns smoothly, in a page of 3 to 6 MB
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


def map_view(folder: RunFolder, triangles: int = _TRIANGLES) -> MapView | None:
    """The map with at most about so many triangles; None without ``map_mesh.ply``.

    It is seen from that one of nine frames, evenly spread over the path, before which most vertices lie.
    """
    trajectory = folder.trajectory("optimised")
    if trajectory is None or not (folder.path / MAP_MESH).is_file():
        return None
    mesh = thinned_mesh(folder.path / MAP_MESH, triangles)
    poses = trajectory.T_world_camera
    frames = np.unique(np.linspace(0, len(poses) - 1, _CANDIDATES + 2)[1:-1].round().astype(int)).tolist()
    depths = [_depths(mesh.points, poses[frame]) for frame in frames]
    best = int(np.argmax([np.count_nonzero(z < _SEEN_WITHIN) for z in depths]))
    ahead = float(np.percentile(depths[best], _NEAR_PERCENT)) if len(depths[best]) else _SEEN_WITHIN
    return MapView(mesh, poses, frames[best], ahead)


def thinned_mesh(path: Path, triangles: int) -> MapMesh:
    """A ``map_mesh.ply`` with at most about so many triangles, by quadric errors; a large one is clustered first."""
    mesh = import_open3d().io.read_triangle_mesh(str(path))
    if not mesh.has_triangles():
        raise RunError(f"{path} is no mesh that can be read: run the sequence again")
    if len(mesh.triangles) > max(_MOST_TRIANGLES, _FINER * triangles):
        mesh = mesh.simplify_vertex_clustering(_COARSER * np.sqrt(2.0 * mesh.get_surface_area() / (_FINER * triangles)))
    if len(mesh.triangles) > triangles:
        mesh = mesh.simplify_quadric_decimation(triangles)
        mesh = mesh.remove_degenerate_triangles().remove_unreferenced_vertices()
    colours = np.asarray(mesh.vertex_colors) if mesh.has_vertex_colors() else np.full_like(mesh.vertices, 0.5)
    rgb = np.rint(255.0 * np.clip(colours, 0.0, 1.0)).astype(np.uint8)
    return MapMesh(np.asarray(mesh.vertices), rgb, np.asarray(mesh.triangles).astype(np.int64))


def _depths(points: FloatArray, T_world_camera: FloatArray) -> FloatArray:
    """Depths of the points ``(P, 3)`` that lie in the field of view."""
    X = apply(invert(T_world_camera), points)
    inside = (X[:, 2] > 0) & (abs(X[:, :2]) < _HALF_FIELD * X[:, 2:]).all(axis=1)
    return np.asarray(X[inside, 2])
