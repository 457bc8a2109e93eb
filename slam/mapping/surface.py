"""The surface of a whole map, one tile in memory at a time.

Tiles are extracted into a spill file. Vertices that neighbouring tiles share are the same bit by bit; by them pieces of
surface are followed from tile to tile, small ones are left out, and the files are written with each vertex once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from erfsfm.common.progress import Progress, silent
from slam.config.sections import MappingConfig
from slam.formats.ply import Ply, write_ply_pieces
from slam.geometry.se3 import FloatArray
from slam.mapping.submap import BLOCK_SIDE, TILE_BLOCKS, MergedSubmaps, SpilledSubmap
from slam.mapping.tile_surface import TileSurface, Triangles, extract_tile, with_holes_closed
from slam.mapping.views import Painter
from slam.runtime.errors import EmptyMapError
from slam.runtime.resources import SpilledArray, SpillFile

_LEAST_WEIGHT = 1.0  # observations of a voxel that becomes surface
_LEAST_TRIANGLES = 300  # of a connected piece; smaller ones float
_LENGTHS, _COLOURS = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
VERTEX = np.dtype([*((name, "<f4") for name in _LENGTHS), *((name, "u1") for name in _COLOURS)])
_FILLED = np.dtype([*VERTEX.descr, ("filled", "u1")])


@dataclass(frozen=True)
class Piece:
    """The part of a tile that is kept in the spill file.

    ``vertices`` ``(V,)`` are records with ``filled``, ``triangles`` ``(T, 3)``, ``label`` ``(V,)`` numbers connected
    parts, ``shared`` ``(S,)`` are vertices that a neighbouring tile may have, too; ``sizes`` counts the triangles of
    each part.
    """

    vertices: SpilledArray
    triangles: SpilledArray
    label: SpilledArray
    shared: NDArray[np.int64]
    shared_points: NDArray[np.float32]
    shared_labels: NDArray[np.int64]
    sizes: NDArray[np.int64]


@dataclass(frozen=True)
class _Rows:
    """Rows ``(V,)`` of a piece's vertices in the whole mesh, -1 where they are left out.

    Those from ``begin`` on are its own, the others an earlier piece's. ``triangles`` are kept.
    """

    numbers: SpilledArray
    begin: int
    triangles: int


class MapSurface:
    """The cleaned surface of finished submaps."""

    def __init__(self, finished: Sequence[SpilledSubmap], config: MappingConfig, progress: Progress = silent) -> None:
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
        self.blocks, self.submaps = submaps.block_count(), submaps.count
        self._extract(submaps, config, progress)
        if not self._pieces:
            raise EmptyMapError("the map is empty: no surface was seen")
        self._rows = _numbered(self._pieces, _LEAST_TRIANGLES, self._spill)
        self.triangles = sum(rows.triangles for rows in self._rows)
        if self.triangles == 0:
            raise EmptyMapError(f"the map is empty: no piece of surface is larger than {_LEAST_TRIANGLES} triangles")
        everything = sum(int(piece.sizes.sum()) for piece in self._pieces)
        self.floater_share = 1 - self.triangles / everything
        sizes = [(len(each), int((each["filled"] == 0).sum())) for each in self.vertex_pieces()]
        self.vertices, self.points = (sum(column) for column in zip(*sizes))

    def vertex_pieces(self) -> Iterator[NDArray[np.void]]:
        """Vertices as records with position, normal, colour and ``filled``, each once, tile by tile."""
        for piece, rows in zip(self._pieces, self._rows):
            numbers, first = np.unique(rows.numbers.read(), return_index=True)
            yield piece.vertices.read()[first[numbers >= rows.begin]]

    def cloud_pieces(self) -> Iterator[NDArray[np.void]]:
        """The observed vertices, without the ones that close holes, as records."""
        for vertices in self.vertex_pieces():
            yield repack_fields(vertices[vertices["filled"] == 0][[*(VERTEX.names or ())]])

    def triangle_pieces(self) -> Iterator[Triangles]:
        """Triangles ``(t, 3)`` of all vertices, tile by tile."""
        for piece, rows in zip(self._pieces, self._rows):
            numbered = rows.numbers.read()[piece.triangles.read()]
            yield numbered[numbered[:, 0] >= 0]

    def meshes(self) -> Iterator[tuple[FloatArray, Triangles]]:
        """Vertices ``(V, 3)`` and triangles ``(T, 3)`` of each tile by itself."""
        for piece, rows in zip(self._pieces, self._rows):
            triangles = piece.triangles.read()
            kept = rows.numbers.read()[triangles[:, 0]] >= 0
            yield Ply(piece.vertices.read()).points, triangles[kept].astype(np.int64)

    def write_mesh(self, path: Path) -> None:
        """Write the mesh as binary PLY, atomically; ``RunError`` where that fails."""
        write_ply_pieces(path, _FILLED, self.vertices, self.vertex_pieces(), self.triangles, self.triangle_pieces())

    def write_cloud(self, path: Path) -> None:
        """Write the cloud as binary PLY, atomically; ``RunError`` where that fails."""
        write_ply_pieces(path, VERTEX, self.points, self.cloud_pieces())

    def _extract(self, submaps: MergedSubmaps, config: MappingConfig, progress: Progress) -> None:
        painter = Painter(submaps, config.voxel_size_m, config.reach_m)
        tiles = submaps.tiles()
        for done, tile in enumerate(tiles, 1):
            patch = extract_tile(submaps, tile, config.voxel_size_m, _LEAST_WEIGHT)
            if patch is not None:
                if config.close_holes_m > 0:
                    up = _upwards(submaps, tile, config.voxel_size_m)
                    patch = with_holes_closed(patch, tile, config.voxel_size_m, up, config.close_holes_m)
                if patch.own.any():
                    self._pieces.append(_piece(patch, painter, self._spill))
            progress("mesh", done, len(tiles))


def _piece(patch: TileSurface, painter: Painter, spill: SpillFile) -> Piece:
    """The part of a patch that belongs to its tile, with colours and normals."""
    is_used = np.zeros(len(patch.vertices), dtype=bool)
    is_used[patch.triangles[patch.own]] = True
    used, renumbered = np.flatnonzero(is_used), np.cumsum(is_used) - 1
    triangles = renumbered[patch.triangles[patch.own]].astype(np.int32)
    is_outside = np.zeros(len(patch.vertices), dtype=bool)
    is_outside[patch.triangles[~patch.own]] = True
    filled = np.zeros(len(patch.vertices), dtype=bool)
    filled[patch.triangles[patch.filled, 2]] = True  # the vertex in the middle of a hole comes last
    vertices = np.empty(len(used), _FILLED)
    columns = np.hstack([patch.vertices, patch.normals()])[used]
    for name, column in zip(_LENGTHS, columns.T, strict=True):
        vertices[name] = column
    for name, shade in zip(_COLOURS, painter.colours(patch.vertices[used]).T, strict=True):
        vertices[name] = shade
    vertices["filled"] = filled[used]
    ends = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    links = coo_array((np.ones(len(ends), dtype=bool), (ends[:, 0], ends[:, 1])), shape=(len(used), len(used)))
    parts, label = connected_components(links, directed=False)
    shared = np.flatnonzero(is_outside[used])
    put = spill.put
    return Piece(
        put(vertices),
        put(triangles),
        put(label.astype(np.int32)),
        shared,
        np.stack([vertices[name][shared] for name in ("x", "y", "z")], axis=1),
        label[shared].astype(np.int64),
        np.bincount(label[triangles[:, 0]], minlength=parts),
    )


def _numbered(pieces: list[Piece], least_triangles: int, spill: SpillFile) -> list[_Rows]:
    """Number the vertices of parts of so many triangles in all tiles together; of a shared one, in its first piece."""
    begin = np.cumsum([0, *(len(piece.sizes) for piece in pieces)])
    points = np.concatenate([piece.shared_points for piece in pieces])
    part = np.concatenate([first + piece.shared_labels for first, piece in zip(begin, pieces)])
    _, earliest, group = np.unique(points, axis=0, return_index=True, return_inverse=True)
    group = group.ravel()
    link = coo_array((np.ones(len(part), dtype=bool), (part, part[earliest[group]])), shape=(begin[-1], begin[-1]))
    _, whole = connected_components(link, directed=False)
    kept_part = np.bincount(whole, weights=np.concatenate([piece.sizes for piece in pieces]))[whole] >= least_triangles
    row_of_group = np.full(len(earliest), -1)
    rows, place, written = [], 0, 0
    for first, last, piece in zip(begin, begin[1:], pieces):
        own = kept_part[first + piece.label.read()]
        numbers = np.full(len(own), -1)
        groups = group[place : place + len(piece.shared)]
        is_first = earliest[groups] == np.arange(place, place + len(groups))
        other, firsts = piece.shared[~is_first], piece.shared[is_first]
        own[other] = False
        count = int(np.count_nonzero(own))
        numbers[own] = np.arange(written, written + count)
        row_of_group[groups[is_first]] = numbers[firsts]
        numbers[other] = row_of_group[groups[~is_first]]
        rows.append(_Rows(spill.put(numbers), written, int(piece.sizes[kept_part[first:last]].sum())))
        place, written = place + len(groups), written + count
    return rows


def _upwards(submaps: MergedSubmaps, tile: NDArray[np.int64], voxel_size_m: float) -> FloatArray:
    """Upwards ``(3,)`` in the camera of the view nearest to a tile."""
    middle = (tile + 0.5) * TILE_BLOCKS * BLOCK_SIDE * voxel_size_m
    nearest = np.linalg.norm(submaps.T_world_views[:, :3, 3] - middle, axis=1).argmin()
    up: FloatArray = -submaps.T_world_views[nearest, :3, 1]
    return up
