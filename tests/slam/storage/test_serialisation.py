"""Plain values, arrays and known records, on disk and back."""

from __future__ import annotations

import json
import zipfile
from collections import OrderedDict, deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.errors import RunError
from slam.storage.serialisation import Learner, Memento, Serialiser


@dataclass(frozen=True)
class Pebble:
    weight: float
    where: NDArray[np.float64] | None


@dataclass(frozen=True)
class Stranger:
    name: str


class Inner(Learner):
    remembers = ("_last",)

    def __init__(self) -> None:
        self._last: Pebble | None = None


class Outer(Learner):
    remembers = ("_inner", "_recent", "_seen", "_count")

    def __init__(self) -> None:
        self._inner = Inner()
        self._recent: deque[float] = deque(maxlen=3)
        self._seen: OrderedDict[int, NDArray[np.uint8]] = OrderedDict()
        self._count = 0


RECORDS = Serialiser(Pebble)


def back(path: Path, value: object) -> object:
    RECORDS.write(path, value=value)
    return RECORDS.read(path)["value"]


@pytest.mark.parametrize(
    "value",
    [None, True, 3, -1.5e-300, float("inf"), 'a "b" é', [], [1, [2.5, None]], (1, ("x",)), {3: "three", "k": (1,)}],
    ids=str,
)
def test_plain_values(tmp_path: Path, value: object) -> None:
    assert back(tmp_path / "r", value) == value


def test_every_double_survives(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=1000).tolist()
    assert back(tmp_path / "r", values) == values


@pytest.mark.parametrize("dtype", ["uint8", "bool", "float32", "float64", "int64"])
@pytest.mark.parametrize("shape", [(), (0, 2), (3,), (2, 3, 4)])
def test_arrays_keep_type_shape_and_bytes(tmp_path: Path, dtype: str, shape: tuple[int, ...]) -> None:
    array = np.asarray(np.random.default_rng(1).integers(0, 2, shape), dtype)
    read = back(tmp_path / "r", array)
    assert isinstance(read, np.ndarray) and read.dtype == array.dtype and read.shape == shape
    assert np.array_equal(read, array) and read.flags.writeable


def test_arrays_that_are_not_contiguous(tmp_path: Path) -> None:
    array = np.arange(24.0).reshape(4, 6)[::2, ::-1]
    assert np.array_equal(back(tmp_path / "r", array), array)


def test_one_array_in_two_places_is_one_array_again(tmp_path: Path) -> None:
    array = np.arange(3)
    RECORDS.write(tmp_path / "r", first=[array, np.arange(3)], second=Pebble(1.0, array))
    read = RECORDS.read(tmp_path / "r")
    assert read["first"][0] is read["second"].where and read["first"][1] is not read["first"][0]


def test_numbers_of_numpy_are_numbers(tmp_path: Path) -> None:
    assert back(tmp_path / "r", [np.int64(3), np.float64(0.1), np.bool_(True)]) == [3, 0.1, True]


def test_a_learner_goes_on_from_what_another_remembered(tmp_path: Path) -> None:
    learned = Outer()
    learned._inner._last = Pebble(2.0, np.arange(2.0))
    learned._recent.extend([1.0, 2.0])
    learned._seen[7] = np.ones(2, np.uint8)
    learned._count = 5
    memento = back(tmp_path / "r", learned)
    assert isinstance(memento, Memento)
    other = Outer()
    other._recent.append(9.0)
    memento.teach(other)
    assert other._inner._last is not None and other._inner._last.weight == 2.0 and other._count == 5
    assert list(other._recent) == [1.0, 2.0] and other._recent.maxlen == 3
    assert isinstance(other._seen, OrderedDict) and np.array_equal(other._seen[7], [1, 1])


def test_a_learner_of_another_kind_is_refused(tmp_path: Path) -> None:
    memento = back(tmp_path / "r", Inner())
    assert isinstance(memento, Memento)
    with pytest.raises(RunError, match="does not fit Outer"):
        memento.teach(Outer())


@pytest.mark.parametrize("value", [object(), Stranger("x"), np.float32(1.0), {1, 2}], ids=lambda v: type(v).__name__)
def test_what_is_not_plain_is_not_written(tmp_path: Path, value: object) -> None:
    with pytest.raises(TypeError, match="no plain value"):
        RECORDS.write(tmp_path / "r", value=value)


def test_records_of_unknown_kinds_are_not_made(tmp_path: Path) -> None:
    Serialiser(Stranger).write(tmp_path / "r", value=Stranger("x"))
    with pytest.raises(RunError, match="damaged"):
        RECORDS.read(tmp_path / "r")


def test_damaged_files(tmp_path: Path) -> None:
    path = tmp_path / "r"
    with pytest.raises(RunError, match="is missing"):
        RECORDS.read(path)
    RECORDS.write(path, value=np.arange(10_000))
    whole = path.read_bytes()
    for damaged in (b"", b"PK\x03\x04", whole[:-100], whole[: len(whole) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(RunError, match="damaged"):
            RECORDS.read(path)


def test_arrays_that_are_cut_short_or_of_objects(tmp_path: Path) -> None:
    path = tmp_path / "r"
    for described, content in ((["<f8", [4]], b"\0" * 16), (["|O", [1]], b"\0" * 8)):
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("tree.json", json.dumps({"format": 1, "values": {"v": {"array": 0}}, "arrays": [described]}))
            file.writestr("arrays.bin", content)
        with pytest.raises(RunError, match="damaged"):
            RECORDS.read(path)


def test_another_version(tmp_path: Path) -> None:
    path = tmp_path / "r"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("tree.json", json.dumps({"format": 2}))
    with pytest.raises(RunError, match="format 2, this version reads 1"):
        RECORDS.read(path)
