"""Decoded frames: once each, within a number of bytes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.data.image_cache import ImageCache

HEIGHT, WIDTH = 256, 512


@dataclass
class Painted:
    """A recording whose frame k is painted k; it counts what is decoded."""

    decoded: list[int] = field(default_factory=list)

    def image(self, index: int, height: int, width: int) -> NDArray[np.uint8]:
        self.decoded.append(index)
        return np.full((height, width, 3), index % 256, np.uint8)


def read(cache: ImageCache, recording: Painted, *indices: int) -> None:
    for index in indices:
        image = cache.image(recording, index)  # type: ignore[arg-type]
        assert image.shape == (HEIGHT, WIDTH, 3)
        assert (image == index).all()


@pytest.mark.parametrize("limit_mb, decoded", [(10, [0, 1]), (0, [0, 1, 0, 1])])
def test_decodes_once_while_there_is_room(limit_mb: int, decoded: list[int]) -> None:
    recording = Painted()
    read(ImageCache(limit_mb, HEIGHT, WIDTH), recording, 0, 1, 0, 1)
    assert recording.decoded == decoded


def test_drops_the_least_recently_used_frame() -> None:
    recording = Painted()
    read(ImageCache(1, HEIGHT, WIDTH), recording, 0, 1, 0, 2, 0, 1)  # two images fit
    assert recording.decoded == [0, 1, 2, 1]


def test_a_returned_image_is_unchanged_when_its_block_is_reused() -> None:
    recording = Painted()
    cache = ImageCache(1, HEIGHT, WIDTH)
    read(cache, recording, 0)
    held = cache.image(recording, 0)  # type: ignore[arg-type]
    read(cache, recording, 1, 2, 3)
    assert (held == 0).all()
    held[:] = 99
    read(cache, recording, 3, 2)


@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="memory is read from /proc, which Linux has")
def test_memory_stays_within_the_limit() -> None:
    """Between short-lived arrays, as a sample makes them."""

    def resident_mb() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20

    recording = Painted()
    cache = ImageCache(200, 128, 416)
    before = resident_mb()
    rng = np.random.default_rng(0)
    for index in range(250):
        cache.image(recording, index)  # type: ignore[arg-type]
        held = [np.ones(int(rng.integers(50_000, 3_000_000)), np.uint8) for _ in range(5)]
        del held
    assert len(recording.decoded) == 250
    assert resident_mb() - before < 2 * 250 * 128 * 416 * 3 / 2**20 + 20
