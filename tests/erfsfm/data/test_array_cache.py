"""Arrays of any shape and kind by key, and decoded frames: once each, within a number of bytes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.data.array_cache import ArrayCache, ImageCache

HEIGHT, WIDTH = 256, 512


@dataclass
class Painted:
    """A recording whose frame k is painted k; it counts what is decoded."""

    decoded: list[int] = field(default_factory=list)
    key: tuple[str, Path] = ("painted", Path())

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


def test_a_returned_image_is_unchanged_when_its_block_is_reused() -> None:
    recording = Painted()
    cache = ImageCache(1, HEIGHT, WIDTH)
    read(cache, recording, 0)
    held = cache.image(recording, 0)  # type: ignore[arg-type]
    read(cache, recording, 1, 2, 3)
    assert (held == 0).all()
    held[:] = 99
    read(cache, recording, 3, 2)


def test_an_array_is_made_once_and_keeps_its_type() -> None:
    cache = ArrayCache(1, (2, 3, 4), np.float16)
    made = []

    def make() -> np.ndarray:
        made.append(1)
        return np.full((2, 3, 4), np.inf, np.float16)

    first, second = cache.get("a", make), cache.get("a", make)
    first[:] = 0
    assert made == [1] and second.dtype == np.float16 and np.isinf(cache.get("a", make)).all()
