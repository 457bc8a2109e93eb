"""Results are read where all inputs are the same, and computed where any differs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam.runtime.errors import SlamError
from slam.runtime.storage.cache import Answer, CacheNamespace, DiskCache


def never() -> Answer:
    raise AssertionError("computed again")


def test_arrays_of_any_kind_come_back_as_they_were(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    answer = rng.normal(size=(3, 4)), np.arange(5, dtype=np.float32), np.zeros((0, 2), np.uint8), np.array(0.1)
    CacheNamespace(DiskCache(tmp_path), "code").get_or_compute("question", ("text", answer[0]), lambda: answer)
    again = CacheNamespace(DiskCache(tmp_path), "code").get_or_compute("question", ("text", answer[0].copy()), never)
    for before, after in zip(answer, again, strict=True):
        np.testing.assert_array_equal(before, after)
        assert before.dtype == after.dtype and before.shape == after.shape


def test_an_empty_result_is_cached(tmp_path: Path) -> None:
    known = CacheNamespace(DiskCache(tmp_path), "code")
    assert known.get_or_compute("question", (), tuple) == ()
    assert known.get_or_compute("question", (), never) == ()


@pytest.mark.parametrize(
    ("identity", "kind", "given"),
    [
        ("other code", "question", ("text", np.arange(4.0))),
        ("code", "other question", ("text", np.arange(4.0))),
        ("code", "question", ("other text", np.arange(4.0))),
        ("code", "question", ("text", np.arange(4.0) + 1e-12)),
        ("code", "question", ("text", np.arange(4.0).reshape(2, 2))),
    ],
)
def test_every_difference_is_computed(
    tmp_path: Path, identity: str, kind: str, given: tuple[str | np.ndarray, ...]
) -> None:
    memory = DiskCache(tmp_path)
    CacheNamespace(memory, "code").get_or_compute("question", ("text", np.arange(4.0)), lambda: (np.zeros(1),))
    other = CacheNamespace(memory, identity)
    (answer,) = other.get_or_compute(kind, given, lambda: (np.ones(1),))
    assert answer == 1 and (other.asked, other.found) == (1, 0)


def test_a_folder_of_something_else_is_no_cache(tmp_path: Path) -> None:
    (tmp_path / "000000.png").write_bytes(b"an image")
    with pytest.raises(SlamError, match="holds no cache of erfsfm-slam: choose another --cache"):
        DiskCache(tmp_path)
