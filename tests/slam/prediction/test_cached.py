"""The networks are asked once; what is read is what they said, and a broken entry is none."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.errors import SlamError
from slam.frames import Image
from slam.prediction.cached import CachedNetworks
from slam.storage.cache import DiskCache


class Counting:
    """Networks whose answers are told by the images, and which count the questions."""

    sources = 4

    def __init__(self) -> None:
        self.asked = 0

    def disparity(self, image: Image) -> NDArray[np.float32]:
        self.asked += 1
        return image[..., 0].astype(np.float32) / 7

    def poses(self, images: Sequence[Image]) -> NDArray[np.float64]:
        self.asked += 1
        T = np.tile(np.eye(4), (4, 1, 1))
        T[:, 0, 3] = [image.mean() for image in images[:4]]
        return T


def pictures(count: int = 5, seed: int = 0) -> list[Image]:
    return list(np.random.default_rng(seed).integers(0, 255, (count, 6, 8, 3), np.uint8))


def entries(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def test_a_second_run_asks_nothing_and_hears_the_same(tmp_path: Path) -> None:
    networks, images = Counting(), pictures()
    first = CachedNetworks(networks, "weights", DiskCache(tmp_path))
    heard = [first.disparity(images[0]), first.poses(images)]
    assert (networks.asked, first.asked, first.found) == (2, 2, 0)
    second = CachedNetworks(networks, "weights", DiskCache(tmp_path))
    copies = [image.copy() for image in images]
    for before, again in zip(heard, [second.disparity(copies[0]), second.poses(copies)], strict=True):
        np.testing.assert_array_equal(before, again)
        assert before.dtype == again.dtype
    assert (networks.asked, second.asked, second.found) == (2, 0, 2)


def test_every_difference_is_another_entry(tmp_path: Path) -> None:
    networks, images = Counting(), pictures()
    cached = CachedNetworks(networks, "weights", DiskCache(tmp_path))
    cached.disparity(images[0])
    cached.poses(images)
    touched = images[0].copy()
    touched[0, 0, 0] ^= 1
    cached.disparity(touched)
    cached.disparity(images[0].reshape(8, 6, 3))
    cached.poses(images[::-1])
    CachedNetworks(networks, "other weights", DiskCache(tmp_path)).disparity(images[0])
    assert networks.asked == len(entries(tmp_path)) == 6


@pytest.mark.parametrize("damage", ["half", "empty", "flipped"])
def test_a_broken_entry_is_computed_and_written_again(
    tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    networks, image = Counting(), pictures()[0]
    expected = CachedNetworks(networks, "weights", DiskCache(tmp_path)).disparity(image)
    (path,) = entries(tmp_path)
    whole = path.read_bytes()
    flipped = whole[:-1] + bytes([whole[-1] ^ 1])
    path.write_bytes({"half": whole[: len(whole) // 2], "empty": b"", "flipped": flipped}[damage])
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(
            CachedNetworks(networks, "weights", DiskCache(tmp_path)).disparity(image), expected
        )
    assert networks.asked == 2 and "damaged" in caplog.text
    assert entries(tmp_path) == [path] and path.read_bytes() == whole


def test_an_image_changed_in_place_is_not_hidden_by_a_new_array(tmp_path: Path) -> None:
    """Digests are remembered by object: a new array in the same place must not inherit one."""
    cached = CachedNetworks(Counting(), "weights", DiskCache(tmp_path))
    for seed in range(20):
        image = pictures(1, seed)[0]
        np.testing.assert_array_equal(cached.disparity(image), image[..., 0].astype(np.float32) / 7)


def test_a_folder_that_cannot_be_made_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SlamError, match=r"no cache can be made in .*file/cache"):
        CachedNetworks(Counting(), "weights", DiskCache(tmp_path / "file" / "cache"))


def test_a_disk_that_fills_up_ends_the_keeping_and_not_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    networks, images = Counting(), pictures()
    cached = CachedNetworks(networks, "weights", DiskCache(tmp_path))
    monkeypatch.setattr(Path, "write_bytes", full)
    for image in images:
        cached.disparity(image)
    assert networks.asked == 5 and caplog.text.count("keeps nothing more") == 1
    assert entries(tmp_path) == []
