from __future__ import annotations

import numpy as np
import pytest

from slam.frames import View
from slam.loops.closure import Apart, find_candidates
from slam.loops.retrieval import hamming
from slam.loops.verification import OF_FRAMES


def place(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (80, 32), dtype=np.uint8)


def seen_again(descriptors: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same corners with a few bits flipped, in another order."""
    bits = np.unpackbits(descriptors, axis=1) ^ (rng.random((len(descriptors), 256)) < 0.04)
    return rng.permutation(np.packbits(bits, axis=1))


def view(index: int, descriptors: np.ndarray) -> View:
    count = len(descriptors)
    return View(index, np.zeros((count, 2), np.float32), descriptors, np.full((count, 3), np.nan, np.float32))


def drive(places: int, again: int) -> list[View]:
    """Each place has two frames; after ``places`` new ones the first ``again`` are revisited."""
    rng = np.random.default_rng(0)
    known = [place(rng) for _ in range(places)]
    order = [*range(places), *range(again)]
    return [view(2 * k + j, seen_again(known[p], rng)) for k, p in enumerate(order) for j in range(2)]


def apart(path: np.ndarray) -> Apart:
    """Thirty frames and fifteen metres."""
    frames = np.arange(len(path))
    return lambda rows: (frames[rows, None] - frames >= 30) & (path[rows, None] - path >= 15.0)


def test_hamming_counts_bits() -> None:
    rng = np.random.default_rng(1)
    first, second = place(rng), place(rng)[:50]
    slow = np.unpackbits(first[:, None] ^ second[None], axis=2).sum(axis=2)
    np.testing.assert_array_equal(hamming(first, second), slow)


def test_revisited_places_are_found() -> None:
    views = drive(20, 5)
    found = find_candidates(views, apart(np.arange(50.0)), OF_FRAMES)
    best = {}
    for candidate in found:
        best.setdefault(candidate.later, candidate)
    for later in range(40, 50):
        assert best[later].earlier // 2 == (later - 40) // 2
        assert best[later].score > 0.5
    assert all(views[c.later].index - views[c.earlier].index >= 30 for c in found)


@pytest.mark.parametrize("path_m", [np.zeros(50), np.linspace(0.0, 4.0, 50)])
def test_a_standing_camera_finds_nothing(path_m: np.ndarray) -> None:
    assert find_candidates(drive(20, 5), apart(path_m), OF_FRAMES) == []


def test_candidates_are_few_and_apart() -> None:
    found = find_candidates(drive(20, 5), apart(np.arange(50.0)), OF_FRAMES)
    for later in {c.later for c in found}:
        earlier = [c.earlier for c in found if c.later == later]
        assert len(earlier) <= 2
        assert len(earlier) < 2 or abs(earlier[0] - earlier[1]) > 10
