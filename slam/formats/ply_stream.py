"""A PLY file written piece by piece, with the same layout as `slam.formats.ply` writes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.formats.ply import TRIANGLE, ply_header
from slam.runtime.errors import RunError
from slam.runtime.storage.files import write_atomically


def write_ply_pieces(
    path: Path,
    vertex_type: np.dtype[np.void],
    vertices: int,
    vertex_pieces: Callable[[], Iterator[NDArray[np.void]]],
    triangles: int | None = None,
    triangle_pieces: Callable[[], Iterator[NDArray[np.int64]]] | None = None,
) -> None:
    """Write a binary PLY, atomically, without its whole content in memory.

    Args:
        path: the file.
        vertex_type: fields of a vertex.
        vertices: their number in all pieces.
        vertex_pieces: structured arrays ``(v,)``, one after another.
        triangles: number of triangles; None for a cloud.
        triangle_pieces: arrays ``(t, 3)`` of indices into all vertices.

    Raises:
        RunError: the file cannot be written.
    """
    header = ply_header(vertex_type, vertices, triangles)

    def fill(partial: Path) -> None:
        with partial.open("wb") as file:
            file.write(header)
            for piece in vertex_pieces():
                file.write(np.ascontiguousarray(piece).view(np.uint8).data)
            for corners in triangle_pieces() if triangle_pieces is not None else ():
                faces = np.empty(len(corners), TRIANGLE)
                faces["count"], faces["vertices"] = 3, corners
                file.write(faces.view(np.uint8).data)

    write_atomically(path, fill, RunError)
