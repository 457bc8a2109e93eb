"""Features of the images of a simulated street, and the distance of descriptors."""

from __future__ import annotations

import numpy as np

from slam.frames import Frame, Intrinsics
from slam.loops.features import FeatureExtractor, hamming
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

SIZE = (312, 96)


def test_features_are_spread_and_bounded():
    street = SimulatedStreet(SimulationOptions("straight", 20, 621, *SIZE))
    intrinsics = Intrinsics(*SIZE, *street.K[[0, 1, 0, 1], [0, 1, 2, 2]])
    extractor = FeatureExtractor(intrinsics)
    image, depth, height_m = street.render(6), street.depth(6), street.camera_height_m
    view = extractor.view(Frame(3, 0.6, image), depth, height_unscaled=height_m)
    assert 100 < len(view) <= 500 and view.descriptors.shape == (len(view), 32)
    known = np.isfinite(view.points).all(axis=1)
    assert known.any() and view.points[known, 2].max() < 30 * height_m
    again = view.points[known] / view.points[known, 2:] @ intrinsics.K.T
    np.testing.assert_allclose(again[:, :2], view.pixels[known], atol=1e-3)
    assert view.pixels[:, 0].std() > 0.15 * SIZE[0]
    fixed = np.zeros((24, 78), bool)
    fixed[:, 39:] = True
    seen = extractor.view(Frame(3, 0.6, image, fixed), depth, height_m)
    assert len(seen) > 100 and seen.pixels[:, 0].max() < SIZE[0] / 2
    blank = extractor.view(Frame(4, 0.4, np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)), depth)
    assert len(blank) == 0


def place(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (80, 32), dtype=np.uint8)


def test_hamming_counts_bits():
    rng = np.random.default_rng(1)
    first, second = place(rng), place(rng)[:50]
    slow = np.unpackbits(first[:, None] ^ second[None], axis=2).sum(axis=2)
    np.testing.assert_array_equal(hamming(first, second), slow)
