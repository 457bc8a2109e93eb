"""The networks behind the ``Predictor`` protocol."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.inference import DepthPosePredictor, PreparedImage
from slam.frames import Frame, Image, Intrinsics, Predictor
from slam.prediction.assembly import NetworkPredictor

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
    predictor: Predictor = NetworkPredictor(direct)
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

    predictor, snippet = NetworkPredictor(Counted()), frames(0)
    for frame in snippet:
        predictor.depth(frame)
    predictor.snippet(snippet)
    assert len(asked) == 5 and len(prepared) == 5


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
