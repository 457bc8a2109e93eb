"""Plain values, arrays and known records, on disk and back."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.runtime.errors import RunError
from slam.runtime.storage.serialisation import Serialiser


@dataclass(frozen=True)
class Pebble:
    weight: float
    where: NDArray[np.float64] | None


@dataclass(frozen=True)
class Stranger:
    name: str


@dataclass(frozen=True)
class Inner:
    last: Pebble | None = None


@dataclass(frozen=True)
class Outer:
    inner: Inner
    recent: tuple[float, ...]
    by_frame: dict[int, NDArray[np.uint8]]
    by_step: dict[tuple[int, int], Pebble]
    count: int = 0
    derived: dict[str, object] = field(default_factory=dict, init=False, compare=False)


SERIALISER = Serialiser(Pebble, Inner, Outer)


def back(path: Path, value: object) -> object:
    SERIALISER.write(path, value)
    return SERIALISER.read(path)


@pytest.mark.parametrize(
    "value",
    [None, True, 3, -1.5e-300, float("inf"), 'a "b" é', [], [1, [2.5, None]], (1, ("x",)), {3: "three", "k": (1,)}],
    ids=str,
)
def test_plain_values(tmp_path: Path, value: object) -> None:
    assert back(tmp_path / "r", value) == value


@pytest.mark.parametrize("dtype", ["uint8", "bool", "float32", "float64", "int64"])
@pytest.mark.parametrize("shape", [(), (0, 2), (3,), (2, 3, 4)])
def test_arrays_keep_type_shape_and_bytes(tmp_path: Path, dtype: str, shape: tuple[int, ...]) -> None:
    array = np.asarray(np.random.default_rng(1).integers(0, 2, shape), dtype)
    read = back(tmp_path / "r", array)
    assert isinstance(read, np.ndarray) and read.dtype == array.dtype and read.shape == shape
    assert np.array_equal(read, array) and read.flags.writeable


def test_a_state_comes_back_with_all_that_it_holds(tmp_path: Path) -> None:
    state = Outer(
        Inner(Pebble(2.0, np.arange(2.0))), (1.0, 2.0), {7: np.ones(2, np.uint8)}, {(3, 4): Pebble(0.5, None)}, 5
    )
    read = back(tmp_path / "r", state)
    assert isinstance(read, Outer) and isinstance(read.inner.last, Pebble)
    assert read.inner.last.weight == 2.0 and np.array_equal(read.inner.last.where, [0.0, 1.0])
    assert (read.recent, read.count) == ((1.0, 2.0), 5)
    assert list(read.by_frame) == [7] and np.array_equal(read.by_frame[7], [1, 1])
    assert read.by_step == {(3, 4): Pebble(0.5, None)}


def test_a_record_of_another_shape_is_refused(tmp_path: Path) -> None:
    """As of an earlier version, whose records had other fields."""

    @dataclass(frozen=True)
    class Earlier:
        weight: float

    Earlier.__name__ = "Pebble"
    Serialiser(Earlier).write(tmp_path / "r", Earlier(1.0))
    with pytest.raises(RunError, match="damaged"):
        SERIALISER.read(tmp_path / "r")


@pytest.mark.parametrize("value", [object(), Stranger("x"), np.float32(1.0), {1, 2}], ids=lambda v: type(v).__name__)
def test_what_is_not_plain_is_not_written(tmp_path: Path, value: object) -> None:
    with pytest.raises(TypeError, match="no plain value"):
        SERIALISER.write(tmp_path / "r", value)


def test_records_of_unknown_kinds_are_not_made(tmp_path: Path) -> None:
    Serialiser(Stranger).write(tmp_path / "r", Stranger("x"))
    with pytest.raises(RunError, match="damaged"):
        SERIALISER.read(tmp_path / "r")


def test_damaged_files(tmp_path: Path) -> None:
    path = tmp_path / "r"
    with pytest.raises(RunError, match="is missing"):
        SERIALISER.read(path)
    SERIALISER.write(path, np.arange(10_000))
    whole = path.read_bytes()
    for damaged in (b"", b"PK\x03\x04", whole[:-100], whole[: len(whole) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(RunError, match="damaged"):
            SERIALISER.read(path)


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED], ids=["stored", "deflated"])
def test_damage_anywhere_is_one_error_or_none(tmp_path: Path, compression: int) -> None:
    """A file that was packed again by another tool is compressed, and fails in zlib where it is damaged."""
    path = tmp_path / "r"
    array = np.random.default_rng(2).integers(0, 9, 2000)
    SERIALISER.write(path, array)
    with zipfile.ZipFile(path) as file:
        members = {name: file.read(name) for name in file.namelist()}
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, content in members.items():
            file.writestr(name, content)
    whole = path.read_bytes()
    refused = 0
    for start in range(0, len(whole), max(len(whole) // 200, 1)):
        path.write_bytes(whole[:start] + bytes(255 - byte for byte in whole[start : start + 4]) + whole[start + 4 :])
        try:
            assert np.array_equal(SERIALISER.read(path), array), "read as something else"
        except RunError as error:
            assert "damaged" in str(error) or "format" in str(error)
            refused += 1
    assert refused > 150


def test_arrays_that_are_cut_short_or_of_objects(tmp_path: Path) -> None:
    path = tmp_path / "r"
    for described, content in ((["<f8", [4]], b"\0" * 16), (["|O", [1]], b"\0" * 8)):
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("tree.json", json.dumps({"format": 9, "value": {"array": 0}, "arrays": [described]}))
            file.writestr("arrays.bin", content)
        with pytest.raises(RunError, match="damaged"):
            SERIALISER.read(path)


def test_another_version(tmp_path: Path) -> None:
    path = tmp_path / "r"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("tree.json", json.dumps({"format": 1}))
    with pytest.raises(RunError, match="format 1, this version reads 9"):
        SERIALISER.read(path)
