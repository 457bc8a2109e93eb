"""Small clouds and meshes for tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.formats.ply import Ply
from slam.geometry.se3 import FloatArray


def coloured_ply(
    points: FloatArray,
    normals: FloatArray,
    colours: FloatArray,
    triangles: NDArray[np.int64] | None = None,
) -> Ply:
    """A cloud, or a mesh with ``triangles``, of points, normals and RGB in [0, 1], ``(P, 3)`` each."""
    names = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    vertices = np.empty(
        len(points), dtype=[(name, "u1" if len(name) > 2 else "<f8") for name in names]
    )
    whole = np.hstack([points, normals, np.rint(np.clip(colours, 0, 1) * 255)])
    for name, column in zip(names, whole.T, strict=True):
        vertices[name] = column
    return Ply(vertices, triangles)
