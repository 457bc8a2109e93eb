"""Points of PLY files, as Open3D and most others write them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from slam.errors import RunError
from slam.se3 import FloatArray

_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2"},
    **{"uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
_GREY = 128


def read_ply_points(path: Path) -> tuple[FloatArray, NDArray[np.uint8]]:
    """Vertices ``(P, 3)`` and their RGB colours ``(P, 3)``, grey where the file has none.

    Raises:
        RunError: no PLY in text or little-endian form, or its vertices do not come first and whole.
    """
    try:
        with path.open("rb") as file:
            is_text, count, vertex = _header(file)
            if is_text:
                rows = [tuple(file.readline().split()) for _ in range(count)]
                vertices = np.array(rows, dtype=vertex)
            else:
                vertices = np.frombuffer(file.read(count * vertex.itemsize), dtype=vertex, count=count)
        points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
        names = ("red", "green", "blue")
        if not set(names) <= set(vertex.names or ()):
            return points, np.full((count, 3), _GREY, np.uint8)
        return points, np.stack([vertices[name].astype(np.uint8) for name in names], axis=1)
    except (OSError, ValueError, KeyError, IndexError, StopIteration) as error:
        raise RunError(f"{path} is no PLY that can be read ({error}): run the sequence again") from error


def _header(file: BinaryIO) -> tuple[bool, int, np.dtype[np.void]]:
    """Whether the body is text, the number of vertices, and one vertex as a record."""
    lines = _words(file)
    if next(lines) != ["ply"]:
        raise ValueError("it does not begin with 'ply'")
    _, form, _ = next(lines)
    if form not in ("ascii", "binary_little_endian"):
        raise ValueError(f"its format is {form}")
    elements: list[tuple[str, int]] = []
    fields: list[tuple[str, str]] = []
    for words in lines:
        if words[0] == "end_header":
            break
        if words[0] == "element":
            elements.append((words[1], int(words[2])))
        elif words[0] == "property" and len(elements) == 1:
            fields.append((words[2], "<" + _TYPES[words[1]]))
    if not elements or elements[0][0] != "vertex":
        raise ValueError("its vertices do not come first")
    return form == "ascii", elements[0][1], np.dtype(fields)


def _words(file: BinaryIO) -> Iterator[list[str]]:
    for line in file:
        words = line.decode("ascii").split()
        if words and words[0] not in ("comment", "obj_info"):
            yield words
