"""The surface of one tile, cut from its blocks with a margin so that neighbouring tiles fit without a seam."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.frames import Mask
from slam.geometry.se3 import FloatArray
from slam.mapping.fusion import new_grid
from slam.mapping.merged_submaps import TILE_BLOCKS, Blocks, MergedSubmaps
from slam.mapping.submap import BLOCK_SIDE
from slam.runtime.imports import import_open3d

Triangles = NDArray[np.int64]


@dataclass(frozen=True)
class TileSurface:
    """Vertices ``(V, 3)`` in the world, triangles ``(T, 3)``, which of them belong to the tile, which close a hole."""

    vertices: FloatArray
    triangles: Triangles
    own: Mask
    filled: Mask

    def normals(self) -> FloatArray:
        """Unit normals ``(V, 3)``: means of the triangles around each vertex, by their area."""
        o3d = import_open3d()
        vertices = o3d.utility.Vector3dVector(self.vertices)
        triangles = o3d.utility.Vector3iVector(self.triangles.astype(np.int32))  # others are converted one by one
        return np.asarray(o3d.geometry.TriangleMesh(vertices, triangles).compute_vertex_normals().vertex_normals)


def extract_tile(
    submaps: MergedSubmaps, tile: NDArray[np.int64], voxel_size_m: float, least_weight: float
) -> TileSurface | None:
    """The surface of a tile and of one block around it; None where there is none.

    Both sides of a border between tiles see the same voxels, so that vertices there are the same bit by bit. A triangle
    belongs to the tile that its centre is in.
    """
    low = tile * TILE_BLOCKS
    mesh = _extract(submaps.merged(low - 1, low + TILE_BLOCKS + 1), voxel_size_m, least_weight)
    if mesh is None:
        return None
    vertices, triangles = _sorted(*mesh)
    own = in_tile(vertices[triangles].mean(axis=1), tile, voxel_size_m)
    if not own.any():
        return None
    return TileSurface(vertices, triangles, own, np.zeros(len(own), dtype=bool))


def in_tile(points: FloatArray, tile: NDArray[np.int64], voxel_size_m: float) -> Mask:
    """Which points ``(P, 3)`` are in a tile."""
    side = voxel_size_m * BLOCK_SIDE * TILE_BLOCKS
    return np.asarray((np.floor(points / side) == tile).all(axis=1))


def _extract(blocks: Blocks, voxel_size_m: float, least_weight: float) -> tuple[FloatArray, Triangles] | None:
    o3d = import_open3d()
    grid: Any = new_grid(voxel_size_m, len(blocks.keys))
    places, _ = grid.hashmap().activate(o3d.core.Tensor(blocks.keys.astype(np.int32)))
    shape = (len(blocks.keys), BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE, 1)
    for name, values in (("tsdf", blocks.tsdf), ("weight", blocks.weight)):
        grid.attribute(name).numpy()[places.numpy()] = values.reshape(shape)
    try:
        # a frame weighs 1
        mesh = grid.extract_triangle_mesh(least_weight - 0.5)
    except RuntimeError:  # Open3D cannot build an empty geometry
        return None
    if mesh.is_empty() or not len(mesh.triangle.indices):
        return None
    return mesh.vertex.positions.numpy().astype(np.float64), mesh.triangle.indices.numpy().astype(np.int64)


def _sorted(vertices: FloatArray, triangles: Triangles) -> tuple[FloatArray, Triangles]:
    """The same mesh in an order that does not depend on Open3D's threads."""
    order = np.lexsort(vertices.T)
    differs = (np.diff(vertices[order], axis=0) != 0).any(axis=1)
    if not differs.all():  # several vertices in one place: by the places that the triangles around them reach
        place = np.empty_like(order)
        place[order] = np.append(0, np.cumsum(differs))
        reached = np.zeros(len(vertices), dtype=np.int64)
        np.add.at(reached, triangles, (place[triangles] ** 2).sum(axis=1)[:, None])  # of integers, in any order
        order = np.lexsort((reached, *vertices.T))
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    triangles = rank[triangles]
    first = triangles.argmin(axis=1)[:, None]  # cyclic rotation keeps the orientation of a triangle
    triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
    return vertices[order], triangles[np.lexsort(triangles.T[::-1])]
