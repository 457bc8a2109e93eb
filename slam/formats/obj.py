"""Meshes as Wavefront OBJ with vertex colours, in full precision: Open3D's writer keeps six digits."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from slam.formats.ply import Ply
from slam.runtime.errors import RunError
from slam.runtime.storage.files import write_atomically

_CHUNK = 100_000


def write_obj(path: Path, mesh: Ply) -> None:
    """Write ``v x y z r g b`` with colours in [0, 1], ``vn`` and ``f``, atomically.

    Raises:
        RunError: the file cannot be written.
    """

    def fill(partial: Path) -> None:
        with partial.open("w", encoding="ascii") as file:
            file.write("# erfsfm-slam: x y z, red green blue\n")
            for lines in _chunks(mesh):
                file.write("".join(lines))

    write_atomically(path, fill, RunError)


def _chunks(mesh: Ply) -> Iterator[list[str]]:
    points, colours, normals = mesh.points, mesh.colours, mesh.normals
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points[part].tolist()]
        if colours is not None:
            shades = (colours[part] / 255.0).tolist()
            lines = [f"{line} {r:.6f} {g:.6f} {b:.6f}" for line, (r, g, b) in zip(lines, shades, strict=True)]
        yield [f"{line}\n" for line in lines]
    if normals is not None:
        for start in range(0, len(normals), _CHUNK):
            yield [f"vn {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in normals[start : start + _CHUNK].tolist()]
    if mesh.triangles is not None:
        corner = "{0}" if normals is None else "{0}//{0}"
        for start in range(0, len(mesh.triangles), _CHUNK):
            corners = (mesh.triangles[start : start + _CHUNK] + 1).tolist()
            yield [f"f {corner.format(a)} {corner.format(b)} {corner.format(c)}\n" for a, b, c in corners]
