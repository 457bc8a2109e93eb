"""Point clouds and triangle meshes: binary PLY files, and the scene in which rays meet triangles.

On a full disk Open3D's writer prints a line for every vertex and reports success, so files are written here, with the
same layout and bytes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray, IntArray
from slam.runtime.errors import RunError
from slam.runtime.files import write_atomically
from slam.runtime.imports import import_open3d

# that Open3D and we write
_TYPES = {"double": "f8", "float": "f4", "uchar": "u1", "int": "i4", "uint": "u4"}
_NAMES = {kind: name for name, kind in _TYPES.items()}
_AXES, _NORMALS, _COLOURS = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
# x right, y ahead, z up
R_UP_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_END = b"end_header\n"
_TRIANGLE = np.dtype([("count", "u1"), ("vertices", "<u4", (3,))])


@dataclass(frozen=True)
class Ply:
    """Vertices as a structured array ``(V,)`` with the fields of the file, and triangles ``(T, 3)`` or None."""

    vertices: NDArray[np.void]
    triangles: IntArray | None = None

    def has(self, names: tuple[str, ...]) -> bool:
        """Whether the vertices have all of these fields."""
        return set(names) <= set(self.vertices.dtype.names or ())

    def columns(self, names: tuple[str, ...]) -> FloatArray:
        """Fields of the vertices ``(V, len(names))``; ``KeyError`` where they lack one."""
        return structured_to_unstructured(self.vertices[list(names)], np.float64)

    @property
    def points(self) -> FloatArray:
        """Positions ``(V, 3)``."""
        return self.columns(_AXES)

    @property
    def colours(self) -> NDArray[np.uint8]:
        """RGB ``(V, 3)``, a middle grey where the file has none."""
        if not self.has(_COLOURS):
            return np.full((len(self.vertices), 3), 128, np.uint8)
        return self.columns(_COLOURS).astype(np.uint8)


def read_ply(path: Path) -> Ply:
    """Read a whole file: every vertex, every triangle, and nothing after them.

    Raises:
        RunError: it is no PLY in little-endian form, is cut short, or holds impossible values.
    """
    try:
        return _checked(path.read_bytes())
    except (OSError, ValueError, KeyError) as error:
        raise RunError(
            f"{path} is no PLY that can be read ({error}): run the sequence again"
        ) from error


def _checked(content: bytes) -> Ply:
    """What a file holds; ``ValueError`` or ``KeyError`` where that is not what its header says."""
    place = content.find(_END) + len(_END)
    if not content.startswith(b"ply\n") or place < len(_END):
        raise ValueError("it does not begin with 'ply', or ends within its header")
    parts: dict[str, NDArray[np.void]] = {}
    for name, (count, fields) in _elements(content[:place].decode("ascii")).items():
        parts[name] = np.frombuffer(content, np.dtype(fields), count, place)
        place += parts[name].nbytes
    if place < len(content) or "vertex" not in parts:
        raise ValueError("it is longer than its header states, or has no vertices")
    faces = parts.get("face")
    ply = Ply(parts["vertex"], None if faces is None else faces["vertices"].astype(np.int64))
    points, triangles = ply.points, ply.triangles
    if not np.isfinite(points).all():
        raise ValueError("a coordinate is not finite")
    if faces is not None and (faces["count"] != 3).any():
        raise ValueError("a face has other than 3 vertices")
    if triangles is not None and ((triangles < 0) | (triangles >= len(points))).any():
        raise ValueError("a triangle has a vertex that does not exist")
    return ply


def rotated(ply: Ply, R_up_world: FloatArray) -> Ply:
    """The same with vertices and normals rotated by ``R_up_world`` ``(3, 3)``."""
    vertices = ply.vertices.copy()
    for names in (_AXES, _NORMALS):
        if ply.has(names):
            turned = ply.columns(names) @ R_up_world.T
            for name, column in zip(names, turned.T, strict=True):
                vertices[name] = column
    return replace(ply, vertices=vertices)


def write_ply(path: Path, ply: Ply) -> None:
    """As `write_ply_pieces`."""
    faces = () if ply.triangles is None else (len(ply.triangles), [ply.triangles])
    write_ply_pieces(path, ply.vertices.dtype, len(ply.vertices), [ply.vertices], *faces)


def write_ply_pieces(
    path: Path,
    vertex_type: np.dtype[np.void],
    vertices: int,
    vertex_pieces: Iterable[NDArray[np.void]],
    triangles: int | None = None,
    triangle_pieces: Iterable[IntArray] = (),
) -> None:
    """Write a binary PLY, atomically, without its whole content in memory.

    Args:
        path: the file.
        vertex_type: fields of a vertex.
        vertices: their number in all pieces.
        vertex_pieces: structured arrays ``(v,)``, one after another.
        triangles: number of triangles; None for a cloud.
        triangle_pieces: arrays ``(t, 3)`` of indices into all vertices.
    """
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment Created by erfsfm-slam",
        f"element vertex {vertices}",
    ]
    lines += [
        f"property {_NAMES[vertex_type[name].str[1:]]} {name}" for name in vertex_type.names or ()
    ]
    if triangles is not None:
        lines += [f"element face {triangles}", "property list uchar uint vertex_indices"]

    def fill(partial: Path) -> None:
        with partial.open("wb") as file:
            file.write("\n".join([*lines, "end_header", ""]).encode("ascii"))
            for piece in vertex_pieces:
                file.write(np.ascontiguousarray(piece).view(np.uint8).data)
            for corners in triangle_pieces:
                faces = np.empty(len(corners), _TRIANGLE)
                faces["count"], faces["vertices"] = 3, corners
                file.write(faces.view(np.uint8).data)

    write_atomically(path, fill, RunError)


def _elements(header: str) -> dict[str, tuple[int, list[tuple[Any, ...]]]]:
    """Count and fields of the elements by name; of a list as many values as a triangle has corners."""
    elements = {}
    fields: list[tuple[Any, ...]] = []
    for line in header.splitlines():
        match line.split():
            case ["format", form, _] if form != "binary_little_endian":
                raise ValueError(f"its format is {form}")
            case ["element", name, count]:
                fields = []
                elements[name] = int(count), fields
            case ["property", "list", count, corner, _]:
                fields += [("count", f"<{_TYPES[count]}"), ("vertices", f"<{_TYPES[corner]}", (3,))]
            case ["property", kind, name]:
                fields.append((name, f"<{_TYPES[kind]}"))
    return elements


def scene_of(vertices: NDArray[np.float32], triangles: NDArray[np.uint32]) -> Any:
    """Open3D's scene of triangles ``(T, 3)`` between vertices ``(V, 3)``."""
    open3d = import_open3d()
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(triangles))
    return scene


def distances(scene: Any, points: FloatArray) -> FloatArray:
    """Distance from points ``(M, 3)`` to the nearest surface of a scene, ``(M,)``."""
    tensor = import_open3d().core.Tensor(points.astype(np.float32))
    return np.asarray(scene.compute_distance(tensor).numpy(), dtype=np.float64)
