"""The map of a finished run as the report shows it: a thinned surface, the drive, and where it is first seen from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.geometry.se3 import FloatArray, apply, invert
from slam.results.folder import RunFolder
from slam.results.report.map_mesh import MapMesh, MapMeshFile
from slam.runtime.run_files import MAP_MESH

_MOST_TRIANGLES = 1_000_000  # that are thinned by quadric errors; a larger mesh is clustered first
_CANDIDATES = 9
_SEEN_WITHIN = 40.0
_NEAR_PERCENT = 10
_HALF_FIELD = np.array([0.9, 0.5])  # tangents, of width and height


@dataclass(frozen=True)
class MapView:
    """A surface, the poses of the drive ``(N, 4, 4)`` in its world, the frame of its ``seat``, and how far ``ahead`` of
    it the map is near."""

    mesh: MapMesh
    T_world_camera: FloatArray
    seat: int
    ahead: float


def map_view(folder: RunFolder, triangles: int) -> MapView | None:
    """The map with at most about so many triangles; None without ``map_mesh.ply``, or where none are wanted.

    The seat is the one of nine frames, evenly spread over the drive, before which most vertices lie.

    Raises:
        RunError: the mesh is damaged.
    """
    trajectory = folder.trajectory("optimised")
    if not triangles or trajectory is None or not (folder.path / MAP_MESH).is_file():
        return None
    mesh = MapMeshFile(folder.path / MAP_MESH).reduced(_MOST_TRIANGLES).decimated(triangles)
    poses = trajectory.T_world_camera
    rows = np.unique(np.linspace(0, len(poses) - 1, _CANDIDATES + 2)[1:-1].round().astype(int)).tolist()
    depths = [_depths(mesh.points, poses[row]) for row in rows]
    best = int(np.argmax([np.count_nonzero(z < _SEEN_WITHIN) for z in depths]))
    ahead = float(np.percentile(depths[best], _NEAR_PERCENT)) if len(depths[best]) else _SEEN_WITHIN
    return MapView(mesh, poses, rows[best], ahead)


def _depths(points: FloatArray, T_world_camera: FloatArray) -> FloatArray:
    """Depths of the points ``(P, 3)`` that lie in the field of view."""
    X = apply(invert(T_world_camera), points)
    inside = (X[:, 2] > 0) & (abs(X[:, :2]) < _HALF_FIELD * X[:, 2:]).all(axis=1)
    return np.asarray(X[inside, 2])
