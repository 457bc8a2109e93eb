"""How much of a mesh stands behind a second surface that faces the same way, as a wall mapped twice does."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray
from slam.runtime.imports import import_open3d

NEAR_M, FAR_M = 0.3, 2.0  # of the second surface in front of the first
_PARALLEL = 0.7  # least cosine of the two normals
_MOST_RAYS = 20_000  # of a piece


def double_wall_share(pieces: Iterable[tuple[FloatArray, NDArray[np.int64]]]) -> float:
    """Share of the area with a parallel surface 0.3 to 2 m before it; NaN without any area.

    Args:
        pieces: vertices ``(V, 3)`` and triangles ``(T, 3)``, whose normals look to where the camera was.
    """
    found = total = 0.0
    for vertices, triangles in pieces:
        corners = vertices[triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        doubled_area = np.linalg.norm(normal, axis=1)
        chosen = np.flatnonzero(doubled_area > 0)
        chosen = chosen[:: -(-len(chosen) // _MOST_RAYS) or 1]
        direction = normal[chosen] / doubled_area[chosen, None]
        is_double = _has_parallel_before(vertices, triangles, corners[chosen].mean(axis=1), direction)
        weight = doubled_area.sum() / max(doubled_area[chosen].sum(), np.finfo(float).tiny)
        found += weight * float(doubled_area[chosen][is_double].sum())
        total += float(doubled_area.sum())
    return found / total if total > 0 else float("nan")


def _has_parallel_before(
    vertices: FloatArray, triangles: NDArray[np.int64], points: FloatArray, direction: FloatArray
) -> NDArray[np.bool_]:
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32)))
    rays = np.concatenate([points + NEAR_M * direction, direction], axis=1).astype(np.float32)
    answer = scene.cast_rays(o3d.core.Tensor(rays))
    cosine = (answer["primitive_normals"].numpy() * direction).sum(axis=1)
    return np.asarray((answer["t_hit"].numpy() <= FAR_M - NEAR_M) & (cosine > _PARALLEL))
