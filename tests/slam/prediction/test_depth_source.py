"""Depth from elsewhere beside the pose network: one unit, unknown pixels, frames without depth."""

from __future__ import annotations

import logging
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Literal

import numpy as np
import pytest

from slam.frames import DepthMap, Frame, Predictor, SnippetPoses
from slam.prediction.depth_source import Disparity, SourcedPredictor, at_size

HEIGHT, WIDTH = 40, 96
# disparity of a road below a far wall, in the networks' unit
SCENE = np.tile(np.maximum(np.linspace(-0.4, 1.0, HEIGHT), 0.05)[:, None], (1, WIDTH)).astype(np.float32)


def frames(first: int = 0, count: int = 5) -> list[Frame]:
    return [Frame(k, 0.1 * k, np.zeros((HEIGHT, WIDTH, 3), np.uint8)) for k in range(first, first + count)]


class Networks:
    """Depth of the scene; every source one unit behind the target."""

    sources = 4

    def depth(self, frame: Frame) -> DepthMap:
        return np.asarray(1 / SCENE, np.float32)

    def snippet(self, frames: list[Frame]) -> SnippetPoses:
        T_source_target = np.tile(np.eye(4), (4, 1, 1))
        T_source_target[:, 2, 3] = 1.0
        indices = [frame.index for frame in frames]
        return SnippetPoses(indices.pop(2), tuple(indices), T_source_target)

    def executor(self) -> Executor:
        return ThreadPoolExecutor(1)


class Source:
    """The scene's disparity times ``gain`` plus ``shift``, known in some frames only."""

    name, sha256 = "npy:depth", "9f"

    def __init__(self, gain: float = 1.0, shift: float = 0.0, unknown: tuple[int, ...] = ()) -> None:
        self._gain, self._shift, self._unknown = gain, shift, unknown

    def disparity(self, frame: Frame) -> Disparity:
        disparity = np.asarray(self._gain * SCENE + self._shift, np.float32)
        return np.full_like(disparity, np.nan) if frame.index in self._unknown else disparity


def predictor(source: Source, align: Literal["none", "scale", "affine"] = "none") -> Predictor:
    return SourcedPredictor(Networks(), source, align)


def shifts(snippet: SnippetPoses) -> np.ndarray:
    return snippet.T_source_target[:, 2, 3]


@pytest.mark.parametrize("gain", [0.02, 1.0, 40.0])
def test_poses_get_the_unit_of_a_source_with_one_unit(gain: float) -> None:
    both = predictor(Source(gain))
    np.testing.assert_allclose(both.depth(frames()[0]), 1 / (gain * SCENE), rtol=1e-5)
    snippet = both.snippet(frames())
    np.testing.assert_allclose(shifts(snippet), 1 / gain, rtol=1e-5)
    assert (snippet.target, snippet.sources) == (2, (0, 1, 3, 4))
    np.testing.assert_array_equal(snippet.T_source_target[:, :3, :3], np.tile(np.eye(3), (4, 1, 1)))


@pytest.mark.parametrize(("align", "shift"), [("scale", 0.0), ("affine", 0.3), ("affine", -0.04)])
def test_each_frame_is_aligned_to_the_networks(align: Literal["scale", "affine"], shift: float) -> None:
    both = predictor(Source(7.0, shift), align)
    np.testing.assert_allclose(both.depth(frames()[0]), 1 / SCENE, rtol=1e-3)
    np.testing.assert_array_equal(shifts(both.snippet(frames())), 1.0)


def test_an_alignment_that_would_turn_near_into_far_is_a_scale() -> None:
    upside_down = Source(-1.0, 1.2)
    depth = predictor(upside_down, "affine").depth(frames()[0])
    known = np.isfinite(depth)
    assert known.all() and (depth > 0).all() and depth[0, 0] < depth[-1, 0]


def test_the_unit_of_a_frame_without_depth_is_that_of_the_nearest(caplog: pytest.LogCaptureFixture) -> None:
    both = predictor(Source(0.5, unknown=(1, 2, 3)))
    with caplog.at_level(logging.WARNING):
        assert np.isnan(both.depth(frames()[2])).all()
        assert np.isfinite(both.depth(frames()[4])).all()
    assert "frame 2 has no known depth in npy:depth" in caplog.text
    np.testing.assert_allclose(shifts(both.snippet(frames())), 2.0, rtol=1e-5)


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (10, 24), (80, 192), (20, 190)])
def test_depth_of_any_size_is_resized_and_unknown_pixels_do_not_spread(size: tuple[int, int]) -> None:
    rows = (np.arange(size[0]) + 0.5) / size[0]
    plane = np.tile((0.1 + 0.9 * rows)[:, None], (1, size[1])).astype(np.float32)
    wanted = np.tile((0.1 + 0.9 * (np.arange(HEIGHT) + 0.5) / HEIGHT)[:, None], (1, WIDTH))
    dense = at_size(plane, HEIGHT, WIDTH)
    np.testing.assert_allclose(dense[4:-4], wanted[4:-4], rtol=0.02)
    plane[:, : size[1] // 2] = np.nan
    half = at_size(plane, HEIGHT, WIDTH)
    np.testing.assert_allclose(half[4:-4, WIDTH // 2 + 6 :], wanted[4:-4, WIDTH // 2 + 6 :], rtol=0.02)
    assert np.isnan(half[:, : WIDTH // 2 - 6]).all() and half.dtype == np.float32
