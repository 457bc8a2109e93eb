"""What a drive has taught the system, on disk and back: numbers, texts, arrays and known records, never code.

A file is a zip of ``tree.json`` and ``arrays.bin``. Arrays are kept at their own precision, and one that is known
in two places is one array again, so that a drive which is continued gives the bytes of one that was never interrupted.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections import OrderedDict, deque
from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.errors import RunError
from slam.storage.archive import reading_archive

_FORMAT = 1
Tree = Any  # of JSON


class Learner:
    """Something that goes on from what it remembers: ``remembers`` names the attributes that hold it."""

    remembers: tuple[str, ...] = ()


class Serialiser:
    """Writes and reads trees of lists, tuples, dictionaries, arrays and records of the given kinds."""

    def __init__(self, *kinds: type) -> None:
        """Know some dataclasses; no others are ever made."""
        self._kinds = {kind.__name__: kind for kind in kinds}

    def write(self, path: Path, **values: Any) -> None:
        """Write values by their names; of a `Learner` what it remembers.

        Raises:
            TypeError: something that is not plain.
        """
        packing = _Packing(self._kinds)
        tree = {name: packing.packed(value) for name, value in values.items()}
        head = {
            "format": _FORMAT,
            "values": tree,
            "arrays": [(array.dtype.str, array.shape) for array in packing.arrays],
        }
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("tree.json", json.dumps(head))
            with file.open("arrays.bin", "w", force_zip64=True) as content:
                for array in packing.arrays:
                    content.write(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)

    def read(self, path: Path) -> dict[str, Any]:
        """Read what ``write`` wrote; for what a `Learner` remembered there is a `Memento`.

        Raises:
            RunError: the file is missing, damaged or of another version.
        """
        with reading_archive(path), zipfile.ZipFile(path) as file:
            head = json.loads(file.read("tree.json"))
            if head["format"] != _FORMAT:
                raise RunError(f"{path} has format {head['format']}, this version reads {_FORMAT}: run again")
            with file.open("arrays.bin") as content:
                arrays = [_array(content.read, *described) for described in head["arrays"]]
            return {name: self._unpacked(tree, arrays) for name, tree in head["values"].items()}

    def _unpacked(self, tree: Tree, arrays: list[NDArray[Any]]) -> Any:
        if isinstance(tree, list):
            return [self._unpacked(each, arrays) for each in tree]
        if not isinstance(tree, dict):
            return tree
        ((kind, content),) = tree.items()
        if kind == "array":
            return arrays[content]
        if kind == "tuple":
            return tuple(self._unpacked(content, arrays))
        if kind == "dict":
            return {key: self._unpacked(value, arrays) for key, value in content}
        if kind == "learnt":
            return Memento({name: self._unpacked(value, arrays) for name, value in content.items()})
        name, values = content
        return self._kinds[name](**{key: self._unpacked(value, arrays) for key, value in values.items()})


class Memento:
    """What a `Learner` remembered."""

    def __init__(self, learnt: dict[str, Any]) -> None:
        self._learnt = learnt

    def teach(self, learner: Learner) -> None:
        """Let another one go on from there.

        Raises:
            RunError: it was another kind of learner.
        """
        if set(self._learnt) != set(learner.remembers):
            raise RunError(f"what is kept of the drive does not fit {type(learner).__name__}: run the sequence again")
        for name, value in self._learnt.items():
            known = getattr(learner, name)
            if isinstance(value, Memento):
                value.teach(known)
            elif isinstance(known, deque):
                known.clear()
                known.extend(value)
            else:
                setattr(learner, name, OrderedDict(value) if isinstance(known, OrderedDict) else value)


class _Packing:
    def __init__(self, kinds: dict[str, type]) -> None:
        self.arrays: list[NDArray[Any]] = []
        self._kinds = kinds
        self._slots: dict[int, int] = {}

    def packed(self, value: Any) -> Tree:
        if value is None or isinstance(value, bool | int | float | str):
            return float(value) if isinstance(value, np.float64) else value
        if isinstance(value, np.integer | np.bool_):
            return value.item()
        if isinstance(value, np.ndarray):
            return {"array": self._slot(value)}
        if isinstance(value, Learner):
            return {"learnt": {name: self.packed(getattr(value, name)) for name in value.remembers}}
        if isinstance(value, tuple):
            return {"tuple": self._each(value)}
        if isinstance(value, list | deque):
            return self._each(value)
        if isinstance(value, dict):
            return {"dict": [(key, self.packed(each)) for key, each in value.items()]}
        if is_dataclass(value) and self._kinds.get(type(value).__name__) is type(value):
            content = {field.name: self.packed(getattr(value, field.name)) for field in fields(value)}
            return {"record": (type(value).__name__, content)}
        raise TypeError(f"a {type(value).__name__} is no plain value")

    def _each(self, values: Iterable[Any]) -> list[Tree]:
        return [self.packed(value) for value in values]

    def _slot(self, array: NDArray[Any]) -> int:
        slot = self._slots.setdefault(id(array), len(self.arrays))
        if slot == len(self.arrays):
            self.arrays.append(array)
        return slot


def _array(read: Any, kind: str, shape: list[int]) -> NDArray[Any]:
    dtype = np.dtype(kind)
    raw = read(dtype.itemsize * math.prod(shape))
    array = np.frombuffer(raw, dtype).reshape(shape)
    return array.copy()
