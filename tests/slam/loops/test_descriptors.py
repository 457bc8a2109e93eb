"""The distance of descriptors."""

from __future__ import annotations

import numpy as np

from slam.loops.descriptors import hamming


def place(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (80, 32), dtype=np.uint8)


def test_hamming_counts_bits() -> None:
    rng = np.random.default_rng(1)
    first, second = place(rng), place(rng)[:50]
    slow = np.unpackbits(first[:, None] ^ second[None], axis=2).sum(axis=2)
    np.testing.assert_array_equal(hamming(first, second), slow)
