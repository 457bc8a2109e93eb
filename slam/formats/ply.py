"""Point clouds and triangle meshes as binary PLY files.

On a full disk Open3D's writer prints a line for every vertex and reports success, so files are written here, with the
same layout and bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray
from slam.runtime.errors import RunError
from slam.runtime.storage.files import write_atomically

_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2"},
    **{"uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
_NAMES = {"f8": "double", "f4": "float", "u1": "uchar", "i1": "char"}
_NAMES |= {"u2": "ushort", "i2": "short", "u4": "uint", "i4": "int"}
_AXES, _NORMALS, _COLOURS = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
_TRIANGLE = np.dtype([("count", "u1"), ("vertices", "<u4", (3,))])


@dataclass(frozen=True)
class Ply:
    """Vertices as a structured array ``(V,)`` with the fields of the file, and triangles ``(T, 3)`` or None."""

    vertices: NDArray[np.void]
    triangles: NDArray[np.int64] | None = None

    def columns(self, names: tuple[str, ...]) -> FloatArray | None:
        """Fields of the vertices ``(V, len(names))``; None where the file lacks one of them."""
        if not set(names) <= set(self.vertices.dtype.names or ()):
            return None
        return np.stack([self.vertices[name].astype(np.float64) for name in names], axis=1)

    @property
    def points(self) -> FloatArray:
        """Positions ``(V, 3)``."""
        return np.stack([self.vertices[name].astype(np.float64) for name in _AXES], axis=1)

    @property
    def colours(self) -> NDArray[np.uint8] | None:
        """RGB ``(V, 3)``, None where the file has none."""
        colours = self.columns(_COLOURS)
        return None if colours is None else colours.astype(np.uint8)

    @property
    def colours_or_grey(self) -> NDArray[np.uint8]:
        """RGB ``(V, 3)``, a middle grey where the file has none."""
        return np.full((len(self.vertices), 3), 128, np.uint8) if self.colours is None else self.colours


_Element = tuple[str, int, list[tuple[Any, ...]]]
"""Name, count and fields of an element of the header."""


def read_ply(path: Path) -> Ply:
    """Read a whole file: every vertex, every triangle, and nothing after them.

    Raises:
        RunError: it is no PLY in little-endian form, is cut short, or holds impossible values.
    """
    parts = _mapped(path)
    vertices, faces = parts["vertex"], parts.get("face")
    try:
        if faces is not None and (faces["count"] != 3).any():
            raise ValueError("a face has other than 3 vertices")
        ply = Ply(np.array(vertices), None if faces is None else faces["vertices"].astype(np.int64))
        _check(ply)
        return ply
    except (ValueError, KeyError) as error:
        raise RunError(f"{path} is no PLY that can be read ({error}): run the sequence again") from error


def _mapped(path: Path) -> dict[str, NDArray[np.void]]:
    """The elements by name, vertices among them."""
    parts: dict[str, NDArray[np.void]] = {}
    try:
        with path.open("rb") as file:
            elements, place = _header(file), file.tell()
        size = path.stat().st_size
        for name, count, fields in elements:
            dtype, start = np.dtype(fields), place
            place += count * dtype.itemsize
            if not start <= place <= size:
                raise ValueError(f"it announces {count} elements '{name}', more than it holds")
            parts[name] = np.memmap(path, dtype, "r", start, (count,)) if count else np.empty(0, dtype)
        if place < size or "vertex" not in parts:
            raise ValueError("it is longer than its header states, or has no vertices")
        return parts
    except (OSError, ValueError, KeyError, IndexError, TypeError, StopIteration) as error:
        reason = str(error) or "it ends within its header"
        raise RunError(f"{path} is no PLY that can be read ({reason}): run the sequence again") from error


def rotated(ply: Ply, R_up_world: FloatArray) -> Ply:
    """The same with vertices and normals rotated by ``R_up_world`` ``(3, 3)``."""
    vertices = ply.vertices.copy()
    for names in (_AXES, _NORMALS):
        directions = ply.columns(names)
        if directions is not None:
            for name, column in zip(names, (directions @ R_up_world.T).T, strict=True):
                vertices[name] = column
    return replace(ply, vertices=vertices)


def write_ply(path: Path, ply: Ply) -> None:
    """Write a binary PLY, atomically.

    Raises:
        RunError: the file cannot be written.
    """
    triangles, vertices = ply.triangles, ply.vertices
    faces = (None, None) if triangles is None else (len(triangles), lambda: iter([triangles]))
    write_ply_pieces(path, vertices.dtype, len(vertices), lambda: iter([vertices]), *faces)


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
    lines = ["ply", "format binary_little_endian 1.0", "comment Created by erfsfm-slam", f"element vertex {vertices}"]
    lines += [f"property {_NAMES[vertex_type[name].str[1:]]} {name}" for name in vertex_type.names or ()]
    if triangles is not None:
        lines += [f"element face {triangles}", "property list uchar uint vertex_indices"]

    def fill(partial: Path) -> None:
        with partial.open("wb") as file:
            file.write("\n".join([*lines, "end_header", ""]).encode("ascii"))
            for piece in vertex_pieces():
                file.write(np.ascontiguousarray(piece).view(np.uint8).data)
            for corners in triangle_pieces() if triangle_pieces is not None else ():
                faces = np.empty(len(corners), _TRIANGLE)
                faces["count"], faces["vertices"] = 3, corners
                file.write(faces.view(np.uint8).data)

    write_atomically(path, fill, RunError)


def _check(ply: Ply) -> None:
    points = ply.columns(_AXES)
    if points is None:
        raise ValueError("its vertices have no x, y, z")
    if not np.isfinite(points).all():
        raise ValueError("a coordinate is not finite")
    triangles = ply.triangles
    if triangles is not None and triangles.size and not 0 <= triangles.min() <= triangles.max() < len(points):
        raise ValueError("a triangle has a vertex that does not exist")


def _header(file: BinaryIO) -> list[_Element]:
    """The elements in their order; of a list as many values as a triangle has corners."""
    lines = _words(file)
    if next(lines) != ["ply"]:
        raise ValueError("it does not begin with 'ply'")
    _, form, _ = next(lines)
    if form != "binary_little_endian":
        raise ValueError(f"its format is {form}")
    elements: list[_Element] = []
    for words in lines:
        if words[0] == "end_header":
            break
        if words[0] == "element":
            elements.append((words[1], int(words[2]), []))
        elif words[1] == "list":
            elements[-1][2].extend([("count", f"<{_TYPES[words[2]]}"), ("vertices", f"<{_TYPES[words[3]]}", (3,))])
        else:
            elements[-1][2].append((words[2], f"<{_TYPES[words[1]]}"))
    else:
        raise ValueError("its header has no end")
    return elements


def _words(file: BinaryIO) -> Iterator[list[str]]:
    for line in file:
        words = line.decode("ascii").split()
        if words and words[0] not in ("comment", "obj_info"):
            yield words
