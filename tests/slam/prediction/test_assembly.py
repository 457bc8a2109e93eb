"""The networks behind the ``Predictor`` protocol."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.inference import DepthPosePredictor
from slam.frames import Frame, Image, Intrinsics, Predictor
from slam.prediction.assembly import NetworkPredictor

CAMERA = Intrinsics(160, 48, 90.0, 90.0, 79.5, 23.5)


@pytest.fixture
def direct(tiny_weights: Path) -> DepthPosePredictor:
    return DepthPosePredictor.from_weights(tiny_weights)


def frames(first: int, count: int = 5) -> list[Frame]:
    rng = np.random.default_rng(first)
    return [
        Frame(k, 0.1 * k, rng.integers(0, 255, (48, 160, 3), np.uint8))
        for k in range(first, first + count)
    ]


def test_outputs_by_frame_are_those_of_the_networks_by_image(direct: DepthPosePredictor):
    predictor: Predictor = NetworkPredictor(direct, CAMERA)
    snippet = frames(10)
    depth = predictor.depth(snippet[0])
    assert depth.shape == (48, 160) and depth.dtype == np.float32 and (depth > 0).all()
    np.testing.assert_array_equal(depth, direct.depth(snippet[0].image))
    poses = predictor.snippet(snippet)
    assert (poses.target, poses.sources) == (12, (10, 11, 13, 14))
    np.testing.assert_array_equal(
        poses.T_source_target, direct.poses([frame.image for frame in snippet])
    )


def test_depth_and_preparation_are_computed_once_a_frame(direct: DepthPosePredictor):
    asked: list[object] = []
    prepared: list[Image] = []

    class Counted:
        sources = direct.sources
        poses = staticmethod(direct.poses)

        def prepare(self, image: Image) -> NDArray[np.float32]:
            prepared.append(image)
            return direct.prepare(image)

        def disparity(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
            asked.append(image)
            return direct.disparity(image)

    predictor, snippet = NetworkPredictor(Counted(), CAMERA), frames(0)
    for frame in snippet:
        predictor.depth(frame)
    predictor.snippet(snippet)
    assert len(asked) == 5 and len(prepared) == 5
