"""The surface of one tile, cut from its blocks with a margin so that neighbouring tiles fit without a seam.

Small holes of the road are closed: flat loops of open edges that look upwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from slam.frames import Mask
from slam.geometry.se3 import FloatArray
from slam.mapping.submap import BLOCK_SIDE, TILE_BLOCKS, Keys, MergedSubmaps, new_grid
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
    mesh = _extract(*submaps.merged(low - 1, low + TILE_BLOCKS + 1), voxel_size_m, least_weight)
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


def _extract(
    keys: Keys, tsdf: NDArray[np.float32], weight: NDArray[np.float32], voxel_size_m: float, least_weight: float
) -> tuple[FloatArray, Triangles] | None:
    o3d = import_open3d()
    grid: Any = new_grid(voxel_size_m, len(keys))
    places, _ = grid.hashmap().activate(o3d.core.Tensor(keys.astype(np.int32)))
    shape = (len(keys), BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE, 1)
    for name, values in (("tsdf", tsdf), ("weight", weight)):
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


_UPWARDS = 0.85  # least cosine to the camera's own upwards
_FLAT = 0.15  # largest height of a hole's edge over its diameter
_MOST_EDGES = 100


def with_holes_closed(
    patch: TileSurface, tile: NDArray[np.int64], voxel_size_m: float, up_world: FloatArray, largest_m: float
) -> TileSurface:
    """Close holes of at most ``largest_m`` across by triangles around a new vertex in their middle.

    Args:
        patch: the surface.
        tile: its tile; a hole belongs to the tile that its middle is in.
        voxel_size_m: of the map.
        up_world: upwards ``(3,)`` near the tile.
        largest_m: largest diameter.
    """
    vertices, triangles, own = [patch.vertices], [patch.triangles], [patch.own]
    count = len(patch.vertices)
    upwards = patch.normals() @ up_world
    for ring in _rings(patch.triangles, upwards):
        corners = patch.vertices[ring]
        middle = corners.mean(axis=0)
        if not _is_small_and_flat(corners - middle, up_world, largest_m):
            continue
        vertices.append(middle[None])
        triangles.append(np.stack([np.roll(ring, -1), ring, np.full(len(ring), count)], axis=1))
        own.append(np.repeat(in_tile(middle[None], tile, voxel_size_m), len(ring)))
        count += 1
    filled = np.concatenate([np.full(len(each), number > 0) for number, each in enumerate(triangles)])
    return replace(
        patch,
        vertices=np.concatenate(vertices),
        triangles=np.concatenate(triangles),
        own=np.concatenate(own),
        filled=filled,
    )


def _is_small_and_flat(corners: FloatArray, up_world: FloatArray, largest_m: float) -> bool:
    """Whether a ring ``(R, 3)`` around the origin is the edge of a small hole in ground.

    Its edges run as in the triangles beside them, which go round a hole the other way than round a piece of surface.
    """
    if 2 * float(np.linalg.norm(corners, axis=1).max()) > largest_m:
        return False
    (x, y, z), (u, v, w) = corners.T, corners[[*range(1, len(corners)), 0]].T
    area = 0.5 * np.array([y @ w - z @ v, z @ u - x @ w, x @ v - y @ u])
    size = float(np.linalg.norm(area))
    if size == 0 or float(-area @ up_world) < _UPWARDS * size:
        return False
    return float(np.abs(corners @ area).max()) <= _FLAT * largest_m * size


def _rings(triangles: Triangles, upwards: FloatArray) -> list[NDArray[np.int64]]:
    """Closed rings of open edges, each vertex once, in the direction of the triangles beside them.

    Those of at most 100 edges whose vertices look upwards in the mean; ``upwards`` ``(V,)`` are cosines.
    """
    vertices = len(upwards)
    begin, end = _open_edges(triangles, vertices)
    simple = _once(begin, vertices) & _once(end, vertices)
    link = coo_array((np.ones(len(begin), dtype=bool), (begin, end)), shape=(vertices, vertices))
    _, label = connected_components(link, directed=False)
    broken = np.zeros(vertices, dtype=bool)  # rings that touch themselves
    touched = np.zeros(vertices, dtype=bool)
    touched[begin] = touched[end] = True
    broken[label[touched & ~simple]] = True
    edges_of = np.bincount(label[begin], minlength=vertices)
    upwards_of = np.bincount(label[begin], weights=upwards[begin], minlength=vertices)
    broken |= (edges_of > _MOST_EDGES) | (upwards_of < _UPWARDS * edges_of)
    following = np.full(vertices, -1, dtype=np.int64)
    following[begin] = end
    chosen = begin[~broken[label[begin]]]
    _, first = np.unique(label[chosen], return_index=True)
    return [_walk(following, int(start)) for start in chosen[np.sort(first)]]


def _open_edges(triangles: Triangles, vertices: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Begins and ends of the edges of one triangle alone, in its direction."""
    begin, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    codes = np.sort(2 * (low * vertices + high) + (begin > end))  # sorting numbers alone is fast
    is_new = np.concatenate([[True], codes[1:] // 2 != codes[:-1] // 2, [True]])
    codes = codes[is_new[1:] & is_new[:-1]]
    low, high = np.divmod(codes // 2, vertices)
    is_down = codes % 2 == 1
    return np.where(is_down, high, low), np.where(is_down, low, high)


def _once(ends: NDArray[np.int64], vertices: int) -> Mask:
    return np.asarray(np.bincount(ends, minlength=vertices) == 1)


def _walk(following: NDArray[np.int64], start: int) -> NDArray[np.int64]:
    ring = [start]
    while (vertex := int(following[ring[-1]])) != start:
        ring.append(vertex)
    return np.array(ring, dtype=np.int64)
