"""Arrays of any shape and kind by key; see ``test_image_cache.py`` for memory and eviction."""

from __future__ import annotations

import numpy as np

from erfsfm.data.array_cache import ArrayCache


def test_an_array_is_made_once_and_keeps_its_type() -> None:
    cache = ArrayCache(1, (2, 3, 4), np.float16)
    made = []

    def make() -> np.ndarray:
        made.append(1)
        return np.full((2, 3, 4), np.inf, np.float16)

    first, second = cache.get("a", make), cache.get("a", make)
    first[:] = 0
    assert made == [1] and second.dtype == np.float16 and np.isinf(cache.get("a", make)).all()


def test_without_memory_nothing_is_kept() -> None:
    cache = ArrayCache(0, (1,), np.int64)
    assert [int(cache.get("a", lambda k=k: np.array([k]))[0]) for k in range(3)] == [0, 1, 2]
