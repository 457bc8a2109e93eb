"""Simulated weather over a snippet: degraded images, unchanged geometry."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.data.augmentation import weathered


@pytest.fixture
def images() -> list[NDArray[np.uint8]]:
    v, u = np.mgrid[:64, :160]
    spot = np.exp(-((u - 79.5) ** 2 + (v - 31.5) ** 2) / 200)
    return [np.repeat(np.rint(60 + 150 * spot).astype(np.uint8)[..., None], 3, axis=2)] * 5


def test_only_the_seed_decides(images: list[NDArray[np.uint8]]) -> None:
    first, again, other = (weathered(images, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert all(np.array_equal(a, b) for a, b in zip(first, again))
    assert any(not np.array_equal(a, b) for a, b in zip(first, other))


def test_images_stay_images_and_many_get_worse(images: list[NDArray[np.uint8]]) -> None:
    changes = []
    for seed in range(40):
        seen = weathered(images, np.random.default_rng(seed))
        assert [image.shape for image in seen] == [(64, 160, 3)] * 5
        assert all(image.dtype == np.uint8 for image in seen)
        changes.append(np.mean([np.abs(image.astype(float) - images[0]).mean() for image in seen]))
    assert np.mean(np.array(changes) > 3) > 0.6
    assert max(changes) < 100


def test_positions_do_not_change(images: list[NDArray[np.uint8]]) -> None:
    """The mean over much weather has its brightest place where the clear image has it."""
    seen = [image.astype(float)[..., 0] for s in range(60) for image in weathered(images, np.random.default_rng(s))]
    bright = np.maximum(np.mean(seen, axis=0) - 90, 0)
    v, u = np.mgrid[:64, :160]
    assert (u * bright).sum() / bright.sum() == pytest.approx(79.5, abs=1.5)
    assert (v * bright).sum() / bright.sum() == pytest.approx(31.5, abs=1.5)
