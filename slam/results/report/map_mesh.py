"""The mesh of a finished map, reduced to what the report needs; the whole mesh is never in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from slam.formats.ply import Ply, map_ply
from slam.geometry.se3 import FloatArray
from slam.runtime.imports import import_open3d

_CHUNK = 500_000
_COARSER = 1.15  # vertices of one surface do not all meet in its cells
_FINER = 2  # triangles that quadric errors choose from, as a multiple of those that stay
_Kind = TypeVar("_Kind", bound=np.generic)


@dataclass(frozen=True)
class MapMesh:
    """Vertices ``(V, 3)`` in the world, y down, their RGB colours ``(V, 3)`` uint8, and triangles ``(T, 3)``."""

    points: FloatArray
    colours: NDArray[np.uint8]
    triangles: NDArray[np.int64]

    def decimated(self, triangles: int) -> MapMesh:
        """With at most about so many triangles: vertices of cells put together, then quadric errors."""
        if len(self.triangles) <= triangles:
            return self
        coarse = self
        if len(self.triangles) > _FINER * triangles:
            cell = _cell(self, _FINER * triangles)
            coarse = _clustered(lambda: iter([self.points]), self.colours, iter([self.triangles]), cell)
        o3d = import_open3d()
        vector = o3d.utility.Vector3dVector
        mesh = o3d.geometry.TriangleMesh(
            vector(coarse.points), o3d.utility.Vector3iVector(coarse.triangles.astype(np.int32))
        )
        mesh.vertex_colors = vector(coarse.colours / 255.0)
        mesh = mesh.simplify_quadric_decimation(triangles)
        mesh.remove_degenerate_triangles().remove_unreferenced_vertices()
        colours = np.rint(255.0 * np.clip(np.asarray(mesh.vertex_colors), 0.0, 1.0)).astype(np.uint8)
        return MapMesh(np.asarray(mesh.vertices), colours, np.asarray(mesh.triangles).astype(np.int64))


class MapMeshFile:
    """A ``map_mesh.ply`` on disk."""

    def __init__(self, path: Path) -> None:
        """Open it.

        Raises:
            RunError: it is no mesh that can be read.
        """
        self._vertices, self._faces = map_ply(path)

    def reduced(self, triangles: int) -> MapMesh:
        """The whole map with at most about so many triangles."""
        if len(self._faces) <= triangles:
            return self._part(np.ones(len(self._vertices), dtype=bool))
        some = self._part(np.arange(len(self._vertices)) < _CHUNK)
        share = len(some.triangles) / len(self._faces)
        cell = _cell(some, max(int(share * triangles), 1))
        corners = (piece["vertices"] for piece in _chunks(self._faces))
        colours = np.concatenate([piece.colours_or_grey for piece in self._pieces()])
        return _clustered(lambda: (piece.points for piece in self._pieces()), colours, corners, cell)

    def _part(self, inside: NDArray[np.bool_]) -> MapMesh:
        renumbered = np.cumsum(inside) - 1
        faces = (piece["vertices"].astype(np.int64) for piece in _chunks(self._faces))
        kept = [renumbered[corners[inside[corners].all(axis=1)]] for corners in faces]
        triangles = np.concatenate(kept) if kept else np.empty((0, 3), np.int64)
        vertices = Ply(self._vertices[inside])
        return MapMesh(vertices.points, vertices.colours_or_grey, triangles)

    def _pieces(self) -> Iterator[Ply]:
        return map(Ply, _chunks(self._vertices))


def _clustered(
    pieces: Callable[[], Iterator[FloatArray]],
    colours: NDArray[np.uint8],
    corners: Iterator[NDArray[Any]],
    cell: float,
) -> MapMesh:
    """One vertex a cell: the mean of those inside, and of their colours.

    Args:
        pieces: gives the vertices, piece after piece.
        colours: of all vertices, ``(V, 3)``.
        corners: the triangles, piece after piece.
        cell: side of a cell.
    """
    low = np.min([points.min(axis=0) for points in pieces()], axis=0)
    keys = np.concatenate([_keys(points - low, cell) for points in pieces()])
    unique, cells = np.unique(keys, return_inverse=True)
    points = _means(cells, len(unique), pieces())
    shades = _means(cells, len(unique), (part.astype(np.float64) for part in _chunks(colours)))
    triangles = np.concatenate([_not_degenerate(cells[each]) for each in corners])
    return MapMesh(points, shades.round().astype(np.uint8), np.unique(triangles, axis=0))


def _cell(mesh: MapMesh, triangles: int) -> float:
    """The side of cells that leaves about so many triangles, from the area of the surface."""
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return _COARSER * float(np.sqrt(2.0 * area / triangles)) or 1.0


def _keys(offsets: FloatArray, cell: float) -> NDArray[np.int64]:
    """A number for each cell, 21 bits an axis."""
    x, y, z = np.minimum(offsets / cell, 2**21 - 1).astype(np.int64).T
    keys: NDArray[np.int64] = (x << 42) | (y << 21) | z
    return keys


def _means(cells: NDArray[np.intp], count: int, pieces: Iterator[FloatArray]) -> FloatArray:
    sums, start = np.zeros((count, 3)), 0
    for piece in pieces:
        for axis in range(3):
            sums[:, axis] += np.bincount(cells[start : start + len(piece)], piece[:, axis], count)
        start += len(piece)
    return sums / np.bincount(cells, minlength=count)[:, None]


def _not_degenerate(triangles: NDArray[np.intp]) -> NDArray[np.int64]:
    a, b, c = triangles.T
    kept: NDArray[np.int64] = triangles[(a != b) & (b != c) & (a != c)].astype(np.int64)
    return kept


def _chunks(whole: NDArray[_Kind]) -> Iterator[NDArray[_Kind]]:
    for start in range(0, len(whole), _CHUNK):
        yield whole[start : start + _CHUNK]
