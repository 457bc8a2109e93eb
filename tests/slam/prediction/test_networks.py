"""The networks behind the ``Predictor`` protocol, and the cache of their answers."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.inference import DepthPosePredictor, PreparedImage
from slam.frames import Frame, Image, Intrinsics, Predictor
from slam.prediction.networks import NetworkPredictor
from slam.runtime.storage.cache import CacheNamespace, DiskCache

CAMERA = Intrinsics(160, 48, 90.0, 90.0, 79.5, 23.5)


@pytest.fixture
def direct(tiny_weights: Path) -> DepthPosePredictor:
    return DepthPosePredictor.from_weights(tiny_weights)


def frames(first: int, count: int = 5) -> list[Frame]:
    rng = np.random.default_rng(first)
    return [Frame(k, 0.1 * k, rng.integers(0, 255, (48, 160, 3), np.uint8)) for k in range(first, first + count)]


def again(asked: Sequence[Frame]) -> list[Frame]:
    """The same images in frames that nothing was computed for yet."""
    return [Frame(frame.index, frame.stamp, frame.image.copy()) for frame in asked]


def test_outputs_by_frame_are_those_of_the_networks_by_image(direct: DepthPosePredictor) -> None:
    predictor: Predictor = NetworkPredictor(direct, CAMERA)
    snippet = frames(10)
    depth = predictor.depth(snippet[0])
    assert depth.shape == (48, 160) and depth.dtype == np.float32 and (depth > 0).all()
    np.testing.assert_array_equal(depth, direct.depth(snippet[0].image))
    poses = predictor.snippet(snippet)
    assert (poses.target, poses.sources) == (12, (10, 11, 13, 14))
    np.testing.assert_array_equal(poses.T_source_target, direct.poses([frame.image for frame in snippet]))


def test_depth_and_preparation_are_computed_once_a_frame(direct: DepthPosePredictor) -> None:
    asked: list[object] = []
    prepared: list[Image] = []

    class Counted:
        sources = direct.sources
        poses = staticmethod(direct.poses)

        def prepare(self, image: Image) -> PreparedImage:
            prepared.append(image)
            return direct.prepare(image)

        def disparity(self, image: PreparedImage) -> NDArray[np.float32]:
            asked.append(image)
            return direct.disparity(image)

    predictor, snippet = NetworkPredictor(Counted(), CAMERA), frames(0)
    for frame in snippet:
        predictor.depth(frame)
    predictor.snippet(snippet)
    assert len(asked) == 5 and len(prepared) == 5


def test_the_executor_is_one_thread_that_ends_with_its_user(direct: DepthPosePredictor) -> None:
    with NetworkPredictor(direct, CAMERA).executor() as executor:
        names = {executor.submit(lambda: threading.current_thread().name).result() for _ in range(4)}
        assert names == {"networks_0"}
    assert not {thread.name for thread in threading.enumerate()} & names


class Answered(NamedTuple):
    """An image as ``Counting`` prepares it."""

    image: Image


class Counting:
    """Networks whose outputs are a formula of the images; they count their calls."""

    sources = 4

    def __init__(self, gain: int = 1) -> None:
        self.asked = 0
        self.prepared = 0
        self._gain = gain

    def prepare(self, image: Image) -> Answered:
        self.prepared += 1
        return Answered(image)

    def disparity(self, image: Answered) -> NDArray[np.float32]:
        self.asked += 1
        return self._gain * (image.image[..., 0].astype(np.float32) + 1) / 7

    def poses(self, images: Sequence[Answered]) -> NDArray[np.float64]:
        self.asked += 1
        T = np.tile(np.eye(4), (4, 1, 1))
        T[:, 0, 3] = [image.image.mean() for image in images[:4]]
        return T


def cached(networks: Counting, folder: Path, identity: str = "weights") -> tuple[NetworkPredictor, CacheNamespace]:
    """A predictor whose networks' answers are kept in a folder."""
    namespace = CacheNamespace(DiskCache(folder), identity)
    return NetworkPredictor(networks, CAMERA, answers=namespace.get_or_compute), namespace


def entries(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def test_a_second_run_reads_every_output_from_the_cache(tmp_path: Path) -> None:
    networks, snippet = Counting(), frames(0)
    first, namespace = cached(networks, tmp_path)
    depth, poses = first.depth(snippet[2]), first.snippet(snippet)
    assert (networks.asked, namespace.asked, namespace.found) == (2, 2, 0)
    networks.prepared = 0
    second, namespace = cached(networks, tmp_path)
    copies = again(snippet)
    np.testing.assert_array_equal(second.depth(copies[2]), depth)
    found = second.snippet(copies)
    np.testing.assert_array_equal(found.T_source_target, poses.T_source_target)
    assert found.T_source_target.dtype == poses.T_source_target.dtype
    assert (networks.asked, namespace.asked, namespace.found) == (2, 0, 2)
    assert networks.prepared == 0, "images whose answers are known need not be prepared"


def test_any_different_input_is_another_entry(tmp_path: Path) -> None:
    networks, snippet = Counting(), frames(0)
    predictor, _ = cached(networks, tmp_path)
    predictor.depth(snippet[2])
    predictor.snippet(snippet)
    touched = snippet[0].image.copy()
    touched[0, 0, 0] ^= 1
    predictor.depth(Frame(0, 0.0, touched))
    predictor.depth(Frame(0, 0.0, snippet[2].image.reshape(160, 48, 3)))
    predictor.snippet([snippet[k] for k in (4, 3, 2, 1, 0)])
    cached(networks, tmp_path, "other weights")[0].depth(again(snippet)[2])
    assert networks.asked == len(entries(tmp_path)) == 6


@pytest.mark.parametrize("damage", ["half", "empty", "flipped"])
def test_a_broken_entry_is_computed_and_written_again(
    tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    networks, (frame,) = Counting(), frames(0, 1)
    expected = cached(networks, tmp_path)[0].depth(frame)
    (path,) = entries(tmp_path)
    whole = path.read_bytes()
    flipped = whole[:-1] + bytes([whole[-1] ^ 1])
    path.write_bytes({"half": whole[: len(whole) // 2], "empty": b"", "flipped": flipped}[damage])
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(cached(networks, tmp_path)[0].depth(*again([frame])), expected)
    assert networks.asked == 2 and "damaged" in caplog.text
    assert entries(tmp_path) == [path] and path.read_bytes() == whole


def test_a_new_image_in_the_memory_of_an_old_one_is_another_image(tmp_path: Path) -> None:
    """Digests belong to frames: a new array at the same address must not inherit one."""
    predictor, _ = cached(Counting(), tmp_path)
    for seed in range(20):
        (frame,) = frames(seed, 1)
        np.testing.assert_array_equal(predictor.depth(frame), 1 / ((frame.image[..., 0].astype(np.float32) + 1) / 7))
        del frame
