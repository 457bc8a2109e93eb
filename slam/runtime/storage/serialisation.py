"""Trees of numbers, texts, arrays and known dataclasses on disk and back; reading never executes code.

A file is a zip of ``tree.json`` and ``arrays.bin``. Arrays keep their own precision, and an array referenced
twice is read as one array, so that a resumed session gives the bytes of one without interruption.
"""

from __future__ import annotations

import functools
import json
import math
import zipfile
from collections.abc import Iterable
from dataclasses import Field, fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from slam.runtime.errors import RunError
from slam.runtime.storage.archive import opened_archive

_FORMAT = 10
Tree = Any  # of JSON


class Serialiser:
    """Writes and reads trees of lists, tuples, dictionaries, arrays and dataclasses of the given kinds."""

    def __init__(self, *kinds: type) -> None:
        """Register the dataclasses; no others are constructed."""
        self._kinds = {kind.__name__: kind for kind in kinds}

    def write(self, path: Path, value: Any) -> None:
        """Write a value.

        Raises:
            TypeError: a value of another type.
        """
        packing = _Packing(self._kinds)
        tree = packing.packed(value)
        head = {
            "format": _FORMAT,
            "value": tree,
            "arrays": [(array.dtype.str, array.shape) for array in packing.arrays],
        }
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("tree.json", json.dumps(head, allow_nan=False))
            with file.open("arrays.bin", "w", force_zip64=True) as content:
                for array in packing.arrays:
                    content.write(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)

    def read(self, path: Path) -> Any:
        """Read what ``write`` wrote.

        Raises:
            RunError: the file is missing, damaged or of another version.
        """
        with opened_archive(path) as file:
            head = json.loads(file.read("tree.json"))
            if head["format"] != _FORMAT:
                raise RunError(f"{path} has format {head['format']}, this version reads {_FORMAT}: run again")
            with file.open("arrays.bin") as content:
                arrays = [_array(content.read, *described) for described in head["arrays"]]
            return self._unpacked(head["value"], arrays)

    def _unpacked(self, tree: Tree, arrays: list[NDArray[Any]]) -> Any:
        if isinstance(tree, list):
            return [self._unpacked(each, arrays) for each in tree]
        if not isinstance(tree, dict):
            return tree
        ((kind, content),) = tree.items()
        if kind == "array":
            return arrays[content]
        if kind == "float":
            return float(content)
        if kind == "tuple":
            return tuple(self._unpacked(content, arrays))
        if kind == "dict":
            return {self._unpacked(key, arrays): self._unpacked(value, arrays) for key, value in content}
        name, values = content
        unpacked = {key: self._unpacked(value, arrays) for key, value in values.items()}
        types = _types(self._kinds[name])
        wrong = [key for key, value in unpacked.items() if not _is_of(value, types[key])]
        if wrong:
            raise TypeError(f"{name}.{wrong[0]} is no {types[wrong[0]]}")
        return self._kinds[name](**unpacked)


class _Packing:
    def __init__(self, kinds: dict[str, type]) -> None:
        self.arrays: list[NDArray[Any]] = []
        self._kinds = kinds
        self._slots: dict[int, int] = {}

    def packed(self, value: Any) -> Tree:
        if isinstance(value, float):
            return float(value) if math.isfinite(value) else {"float": repr(float(value))}  # JSON has finite ones only
        if value is None or isinstance(value, bool | int | str):
            return value
        if isinstance(value, np.integer | np.bool_):
            return value.item()
        if isinstance(value, np.ndarray):
            return {"array": self._slot(value)}
        if isinstance(value, tuple):
            return {"tuple": self._each(value)}
        if isinstance(value, list):
            return self._each(value)
        if isinstance(value, dict):
            return {"dict": [(self.packed(key), self.packed(each)) for key, each in value.items()]}
        if is_dataclass(value) and self._kinds.get(type(value).__name__) is type(value):
            content = {field.name: self.packed(getattr(value, field.name)) for field in _given(value)}
            return {"record": (type(value).__name__, content)}
        raise TypeError(f"a {type(value).__name__} is no plain value")

    def _each(self, values: Iterable[Any]) -> list[Tree]:
        return [self.packed(value) for value in values]

    def _slot(self, array: NDArray[Any]) -> int:
        slot = self._slots.setdefault(id(array), len(self.arrays))
        if slot == len(self.arrays):
            self.arrays.append(array)
        return slot


def _given(value: Any) -> Iterable[Field[Any]]:
    """The fields of the constructor; others are derived from them."""
    return (field for field in fields(value) if field.init)


@functools.cache
def _types(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _is_of(value: Any, wanted: Any) -> bool:
    """Whether a value is of an annotated type; every item of a container is checked."""
    origin, parts = get_origin(wanted), get_args(wanted)
    if wanted is Any:
        return True
    if origin is Literal:
        return value in parts
    if origin in (Union, UnionType):
        return any(_is_of(value, part) for part in parts)
    if origin is tuple:
        whole = isinstance(value, tuple) and (parts[-1] is Ellipsis or len(value) == len(parts))
        kinds = [parts[0]] * len(value) if whole and parts[-1] is Ellipsis else parts
        return whole and all(map(_is_of, value, kinds))
    if origin is list:
        return isinstance(value, list) and all(_is_of(each, parts[0]) for each in value)
    if isinstance(origin, type) and issubclass(dict, origin):
        return isinstance(value, dict) and all(_is_of(k, parts[0]) and _is_of(v, parts[1]) for k, v in value.items())
    if wanted is float:
        return isinstance(value, float | int) and not isinstance(value, bool)
    return isinstance(value, origin or wanted) and (wanted is not int or not isinstance(value, bool))


def _array(read: Any, kind: str, shape: list[int]) -> NDArray[Any]:
    dtype = np.dtype(kind)
    raw = read(dtype.itemsize * math.prod(shape))
    array = np.frombuffer(raw, dtype).reshape(shape)
    return array.copy()
