"""The surface of a whole map, one tile in memory at a time.

A tile is cut from its blocks with a margin so that neighbouring tiles fit without a seam. Small holes of the road are
closed: flat loops of open edges that look upwards. Tiles are extracted into a spill file. Vertices that neighbouring
tiles share are the same bit by bit; by them pieces of surface are followed from tile to tile, small ones are left out,
and the files are written with each vertex once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from erfsfm.common.progress import Progress
from slam.config.sections import MappingConfig
from slam.formats.ply import Ply, write_ply_pieces
from slam.frames import Intrinsics, Mask
from slam.geometry.se3 import FloatArray, IntArray, length_of
from slam.mapping.submap import (
    BLOCK_SIDE,
    TILE_BLOCKS,
    Keys,
    MergedSubmaps,
    Painter,
    SpilledSubmap,
    new_grid,
)
from slam.runtime.errors import EmptyMapError
from slam.runtime.imports import import_open3d
from slam.runtime.memory import Spilled, SpillFile

_LEAST_WEIGHT = 1.0  # observations of a voxel that becomes surface
_LEAST_TRIANGLES = 300  # of a connected piece; smaller ones float
_LENGTHS, _COLOURS = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
VERTEX = np.dtype([*((name, "<f4") for name in _LENGTHS), *((name, "u1") for name in _COLOURS)])
_FILLED = np.dtype([*VERTEX.descr, ("filled", "u1")])
Triangles = NDArray[np.int64]
_UPWARDS = 0.85  # least cosine to the camera's own upwards
_FLAT = 0.15  # largest height of a hole's edge over its diameter
_MOST_EDGES = 100


@dataclass(frozen=True)
class Piece:
    """The part of a tile that is kept in the spill file.

    ``vertices`` ``(V,)`` are records with ``filled``, ``triangles`` ``(T, 3)``, ``label`` ``(V,)`` numbers connected
    parts, ``shared`` ``(S,)`` are vertices that a neighbouring tile may have, too; ``sizes`` counts the triangles of
    each part.
    """

    vertices: Spilled
    triangles: Spilled
    label: Spilled
    shared: IntArray
    sizes: IntArray


class MapSurface:
    """The cleaned surface of finished submaps."""

    def __init__(
        self,
        finished: Sequence[SpilledSubmap],
        config: MappingConfig,
        camera: Intrinsics,
        progress: Progress,
    ) -> None:
        """Merge the submaps and extract their surface.

        Raises:
            EmptyMapError: nothing was fused or seen often enough.
            SlamError: the disk is full.
        """
        if not finished:
            raise EmptyMapError("the map is empty: no depth passed the filters")
        submaps = MergedSubmaps(finished)
        self._spill = SpillFile("the map")
        self._pieces: list[Piece] = []
        self.blocks, self.submaps = submaps.blocks, submaps.count
        painter = Painter(submaps, config, camera)
        tiles = submaps.tiles()
        for done, tile in enumerate(tiles, 1):
            patch = extract_tile(submaps, tile, config.voxel_size_m)
            if patch is not None and config.close_holes_m > 0:
                # upwards in the camera of the view nearest to the tile
                middle = (tile + 0.5) * TILE_BLOCKS * BLOCK_SIDE * config.voxel_size_m
                nearest = np.linalg.norm(submaps.T_world_views[:, :3, 3] - middle, axis=1).argmin()
                up = -submaps.T_world_views[nearest, :3, 1]
                patch = with_holes_closed(
                    patch, tile, config.voxel_size_m, up, config.close_holes_m
                )
            if patch is not None and patch.own.any():
                self._pieces.append(_piece(patch, painter, self._spill))
            progress("mesh", done, len(tiles))
        if not self._pieces:
            raise EmptyMapError("the map is empty: no surface was seen")
        self._rows, self.triangles = _numbered(self._pieces, _LEAST_TRIANGLES, self._spill)
        if self.triangles == 0:
            raise EmptyMapError(
                f"the map is empty: no piece of surface is larger than {_LEAST_TRIANGLES} triangles"
            )
        everything = sum(int(piece.sizes.sum()) for piece in self._pieces)
        self.floater_share = 1 - self.triangles / everything
        self.vertices = self.points = 0
        for each in self.vertex_pieces():
            self.vertices += len(each)
            self.points += int((each["filled"] == 0).sum())

    def vertex_pieces(self) -> Iterator[NDArray[np.void]]:
        """Vertices as records with position, normal, colour and ``filled``, each once, tile by tile."""
        for piece, (rows, begin) in zip(self._pieces, self._rows):
            numbers, first = np.unique(rows(), return_index=True)
            yield piece.vertices()[first[numbers >= begin]]

    def cloud_pieces(self) -> Iterator[NDArray[np.void]]:
        """The observed vertices, without the ones that close holes, as records."""
        for vertices in self.vertex_pieces():
            yield repack_fields(vertices[vertices["filled"] == 0][[*(VERTEX.names or ())]])

    def triangle_pieces(self) -> Iterator[Triangles]:
        """Triangles ``(t, 3)`` of all vertices, tile by tile."""
        for piece, (rows, _) in zip(self._pieces, self._rows):
            numbered = rows()[piece.triangles()]
            yield numbered[numbered[:, 0] >= 0]

    def meshes(self) -> Iterator[tuple[FloatArray, Triangles]]:
        """Vertices ``(V, 3)`` and triangles ``(T, 3)`` of each tile by itself."""
        for piece, (rows, _) in zip(self._pieces, self._rows):
            triangles = piece.triangles()
            kept = rows()[triangles[:, 0]] >= 0
            yield Ply(piece.vertices()).points, triangles[kept].astype(np.int64)

    def write_mesh(self, path: Path) -> None:
        """Write the mesh as binary PLY, atomically; ``RunError`` where that fails."""
        write_ply_pieces(
            path,
            _FILLED,
            self.vertices,
            self.vertex_pieces(),
            self.triangles,
            self.triangle_pieces(),
        )

    def write_cloud(self, path: Path) -> None:
        """Write the cloud as binary PLY, atomically; ``RunError`` where that fails."""
        write_ply_pieces(path, VERTEX, self.points, self.cloud_pieces())


def _piece(patch: TileSurface, painter: Painter, spill: SpillFile) -> Piece:
    """The part of a patch that belongs to its tile, with colours and normals."""
    is_used = np.zeros(len(patch.vertices), dtype=bool)
    is_used[patch.triangles[patch.own]] = True
    used, renumbered = np.flatnonzero(is_used), np.cumsum(is_used) - 1
    triangles = renumbered[patch.triangles[patch.own]].astype(np.int32)
    vertices = np.empty(len(used), _FILLED)
    columns = np.hstack([patch.vertices, patch.normals()])[used]
    for name, column in zip(_LENGTHS, columns.T, strict=True):
        vertices[name] = column
    for name, shade in zip(_COLOURS, painter.colours(patch.vertices[used]).T, strict=True):
        vertices[name] = shade
    vertices["filled"] = used >= patch.observed
    ends = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    links = coo_array(
        (np.ones(len(ends), dtype=bool), (ends[:, 0], ends[:, 1])), shape=(len(used), len(used))
    )
    parts, label = connected_components(links, directed=False)
    shared = np.flatnonzero(np.isin(used, patch.triangles[~patch.own]))
    put = spill.put
    return Piece(
        put(vertices),
        put(triangles),
        put(label.astype(np.int32)),
        shared,
        np.bincount(label[triangles[:, 0]], minlength=parts),
    )


def _numbered(
    pieces: list[Piece], least_triangles: int, spill: SpillFile
) -> tuple[list[tuple[Spilled, int]], int]:
    """Number the vertices of parts of so many triangles in all tiles together; of a shared one, in its first piece.

    Returns:
        Of each piece the rows ``(V,)`` of its vertices in the whole mesh, -1 where they are left out, and the first
        that is its own: those before are an earlier piece's. And how many triangles are kept.
    """
    begin = np.cumsum([0, *(len(piece.sizes) for piece in pieces)])
    points = np.concatenate([Ply(piece.vertices()).points[piece.shared] for piece in pieces])
    part = np.concatenate(
        [first + piece.label()[piece.shared] for first, piece in zip(begin, pieces)]
    )
    _, earliest, group = np.unique(points, axis=0, return_index=True, return_inverse=True)
    group = group.ravel()
    link = coo_array(
        (np.ones(len(part), dtype=bool), (part, part[earliest[group]])),
        shape=(begin[-1], begin[-1]),
    )
    _, whole = connected_components(link, directed=False)
    kept_part = (
        np.bincount(whole, weights=np.concatenate([piece.sizes for piece in pieces]))[whole]
        >= least_triangles
    )
    row_of_group = np.full(len(earliest), -1)
    rows, place, written, triangles = [], 0, 0, 0
    for first, last, piece in zip(begin, begin[1:], pieces):
        own = kept_part[first + piece.label()]
        numbers = np.full(len(own), -1)
        groups = group[place : place + len(piece.shared)]
        is_first = earliest[groups] == np.arange(place, place + len(groups))
        own[piece.shared[~is_first]] = False
        count = int(np.count_nonzero(own))
        numbers[own] = np.arange(written, written + count)
        row_of_group[groups[is_first]] = numbers[piece.shared[is_first]]
        numbers[piece.shared] = row_of_group[groups]
        rows.append((spill.put(numbers), written))
        triangles += int(piece.sizes[kept_part[first:last]].sum())
        place, written = place + len(groups), written + count
    return rows, triangles


@dataclass(frozen=True)
class TileSurface:
    """Vertices ``(V, 3)`` in the world, triangles ``(T, 3)``, and which of them belong to the tile.

    Vertices from number ``observed`` on close holes.
    """

    vertices: FloatArray
    triangles: Triangles
    own: Mask
    observed: int

    def normals(self) -> FloatArray:
        """Unit normals ``(V, 3)``: means of the triangles around each vertex, by their area."""
        o3d = import_open3d()
        vertices = o3d.utility.Vector3dVector(self.vertices)
        # others are converted one by one
        triangles = o3d.utility.Vector3iVector(self.triangles.astype(np.int32))
        return np.asarray(
            o3d.geometry.TriangleMesh(vertices, triangles).compute_vertex_normals().vertex_normals
        )


def extract_tile(submaps: MergedSubmaps, tile: IntArray, voxel_size_m: float) -> TileSurface | None:
    """The surface of a tile and of one block around it; None where there is none.

    Both sides of a border between tiles see the same voxels, so that vertices there are the same bit by bit. A triangle
    belongs to the tile that its centre is in.
    """
    low = tile * TILE_BLOCKS
    mesh = _extract(*submaps.merged(low - 1, low + TILE_BLOCKS + 1), voxel_size_m)
    if mesh is None:
        return None
    vertices, triangles = _sorted(*mesh)
    own = in_tile(vertices[triangles].mean(axis=1), tile, voxel_size_m)
    if not own.any():
        return None
    return TileSurface(vertices, triangles, own, len(vertices))


def in_tile(points: FloatArray, tile: IntArray, voxel_size_m: float) -> Mask:
    """Which points ``(P, 3)`` are in a tile."""
    side = voxel_size_m * BLOCK_SIDE * TILE_BLOCKS
    return (np.floor(points / side) == tile).all(axis=1)


def _extract(
    keys: Keys, tsdf: NDArray[np.float32], weight: NDArray[np.float32], voxel_size_m: float
) -> tuple[FloatArray, Triangles] | None:
    o3d = import_open3d()
    grid: Any = new_grid(voxel_size_m, len(keys))
    places, _ = grid.hashmap().activate(o3d.core.Tensor(keys.astype(np.int32)))
    shape = (len(keys), BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE, 1)
    for name, values in (("tsdf", tsdf), ("weight", weight)):
        grid.attribute(name).numpy()[places.numpy()] = values.reshape(shape)
    try:
        # a frame weighs 1
        mesh = grid.extract_triangle_mesh(_LEAST_WEIGHT - 0.5)
    except RuntimeError:  # Open3D cannot build an empty geometry
        return None
    if mesh.is_empty() or not len(mesh.triangle.indices):
        return None
    return mesh.vertex.positions.numpy().astype(np.float64), mesh.triangle.indices.numpy().astype(
        np.int64
    )


def _sorted(vertices: FloatArray, triangles: Triangles) -> tuple[FloatArray, Triangles]:
    """The same mesh in an order that does not depend on Open3D's threads."""
    order = np.lexsort(vertices.T)
    differs = (np.diff(vertices[order], axis=0) != 0).any(axis=1)
    # several vertices in one place: by the places that the triangles around them reach
    if not differs.all():
        place = np.empty_like(order)
        place[order] = np.append(0, np.cumsum(differs))
        reached = np.zeros(len(vertices), dtype=np.int64)
        # of integers, in any order
        np.add.at(reached, triangles, (place[triangles] ** 2).sum(axis=1)[:, None])
        order = np.lexsort((reached, *vertices.T))
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    triangles = rank[triangles]
    first = triangles.argmin(axis=1)[:, None]  # cyclic rotation keeps the orientation of a triangle
    triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
    return vertices[order], triangles[np.lexsort(triangles.T[::-1])]


def with_holes_closed(
    patch: TileSurface, tile: IntArray, voxel_size_m: float, up_world: FloatArray, largest_m: float
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
    return replace(
        patch,
        vertices=np.concatenate(vertices),
        triangles=np.concatenate(triangles),
        own=np.concatenate(own),
    )


def _is_small_and_flat(corners: FloatArray, up_world: FloatArray, largest_m: float) -> bool:
    """Whether a ring ``(R, 3)`` around the origin is the edge of a small hole in ground.

    Its edges run as in the triangles beside them, which go round a hole the other way than round a piece of surface.
    """
    if 2 * float(np.linalg.norm(corners, axis=1).max()) > largest_m:
        return False
    area = 0.5 * np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
    size = length_of(area)
    if size == 0 or float(-area @ up_world) < _UPWARDS * size:
        return False
    return float(np.abs(corners @ area).max()) <= _FLAT * largest_m * size


def _rings(triangles: Triangles, upwards: FloatArray) -> list[IntArray]:
    """Closed rings of open edges, each vertex once, in the direction of the triangles beside them.

    Those of at most 100 edges whose vertices look upwards in the mean; ``upwards`` ``(V,)`` are cosines.
    """
    begin, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    edges = csr_array((np.ones(len(begin), dtype=bool), (begin, end)), shape=(len(upwards),) * 2)
    begin, end = (edges > edges.T).nonzero()
    # rings that touch themselves are left out
    is_simple = np.bincount(np.append(begin, end), minlength=len(upwards)) == 2
    chosen = is_simple[begin] & is_simple[end]
    following = dict(zip(begin[chosen].tolist(), end[chosen].tolist()))
    rings = []
    while following:
        start, vertex = following.popitem()
        ring = [start]
        while vertex in following:
            ring.append(vertex)
            vertex = following.pop(vertex)
        is_upwards = upwards[ring].mean() >= _UPWARDS
        if vertex == start and is_upwards and len(ring) <= _MOST_EDGES:
            rings.append(np.array(ring))
    return rings
