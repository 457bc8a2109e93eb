"""The networks behind the protocol: what comes out belongs to the frames that went in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from erfsfm.inference import DepthPosePredictor
from slam.frames import Frame, Intrinsics, Predictor
from slam.prediction.networks import NetworkPredictor

CAMERA = Intrinsics(160, 48, 90.0, 90.0, 79.5, 23.5)


@pytest.fixture
def direct(tiny_weights: Path) -> DepthPosePredictor:
    return DepthPosePredictor.from_weights(tiny_weights)


def frames(first: int, count: int = 5) -> list[Frame]:
    rng = np.random.default_rng(first)
    return [Frame(k, 0.1 * k, rng.integers(0, 255, (48, 160, 3), np.uint8)) for k in range(first, first + count)]


def test_answers_by_frame_what_the_networks_answer_by_image(direct: DepthPosePredictor) -> None:
    predictor: Predictor = NetworkPredictor(direct, CAMERA)
    snippet = frames(10)
    depth = predictor.depth(snippet[0])
    assert depth.shape == (48, 160) and depth.dtype == np.float32 and (depth > 0).all()
    np.testing.assert_array_equal(depth, direct.depth(snippet[0].image))
    poses = predictor.snippet(snippet)
    assert (poses.target, poses.sources) == (12, (10, 11, 13, 14))
    np.testing.assert_array_equal(poses.T_source_target, direct.poses([frame.image for frame in snippet]))


def test_a_snippet_of_another_length_is_refused(direct: DepthPosePredictor) -> None:
    with pytest.raises(ValueError, match="5 images; got 3"):
        NetworkPredictor(direct, CAMERA).snippet(frames(0, 3))


def test_depth_is_asked_once_a_frame_and_its_residual_goes_with_a_snippet(direct: DepthPosePredictor) -> None:
    asked = []

    class Counted:
        sources = direct.sources
        poses = staticmethod(direct.poses)

        def disparity(self, image: np.ndarray) -> np.ndarray:
            asked.append(image)
            return direct.disparity(image)

    predictor, snippet = NetworkPredictor(Counted(), CAMERA), frames(0)
    for frame in snippet:
        predictor.depth(frame)
    poses = predictor.snippet(snippet)
    assert len(asked) == 5
    assert poses.residuals is not None and poses.residuals.shape == (4,) and (poses.residuals > 0).all()
