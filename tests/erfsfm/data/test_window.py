"""Arrays of any shape and kind by key, and decoded frames: once each, within a number of bytes."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.data.window import ArrayCache, Snippet, load_window

HEIGHT, WIDTH = 256, 512


@dataclass
class Painted:
    """A recording whose frame k is painted k; it counts what is decoded."""

    decoded: list[int] = field(default_factory=list)
    key: tuple[str, Path] = ("painted", Path())

    def image(self, index: int, height: int, width: int) -> NDArray[np.uint8]:
        self.decoded.append(index)
        return np.full((height, width, 3), index, np.uint8)


@pytest.mark.parametrize("limit_mb, decoded", [(10, [0, 1]), (0, [0, 1, 0, 1])])
def test_decodes_once_while_there_is_room(limit_mb, decoded):
    recording, cache = Painted(), ArrayCache(limit_mb, (HEIGHT, WIDTH, 3), np.uint8)
    for index in (0, 1, 0, 1):
        (image,) = load_window(cache, Snippet(recording, index), 1)  # type: ignore[arg-type]
        assert (image == index).all()
    assert recording.decoded == decoded


def test_a_returned_array_is_the_callers_when_its_place_is_used_again():
    cache = ArrayCache(1, (HEIGHT, WIDTH, 3), np.float16)  # room for one
    held = cache.get("a", lambda: np.full((HEIGHT, WIDTH, 3), np.inf, np.float16))
    cache.get("b", lambda: np.zeros((HEIGHT, WIDTH, 3), np.float16))[:] = 9
    assert np.isinf(held).all() and held.dtype == np.float16
    assert (cache.get("b", lambda: held) == 0).all()
