"""Depth of a drive's keyframes: what neighbours measure, and what is known of the rest."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from erfsfm.mvs.fusion import DepthFusion
from erfsfm.mvs.refine import Decide, Measurement, RefinedDepth
from slam.frames import Frame, Intrinsics
from slam.frontend.drive import Drive
from slam.frontend.measured import Keyframe, Measured
from slam.frontend.visual.depth_error import DepthError
from slam.mapping.depth import KeyframeDepth
from slam.pipeline.estimate import keyframe_depths
from slam.runtime.memory import SpillFile

CAMERA = Intrinsics(64, 32, 50.0, 50.0, 31.5, 15.5)
FRAMES = 6
BY_NETWORK = DepthFusion("default").decide


def depths(
    step: float, guess_sigma: float | None, decide: Decide | None = BY_NETWORK
) -> Callable[[int], KeyframeDepth]:
    """Of a camera that goes sideways by ``step`` a frame before a wall 5 m away, and sees its own bonnet below."""
    spill_file, rng = SpillFile(), np.random.default_rng(0)
    frames = [
        Frame(k, float(k), rng.integers(0, 255, (32, 64, 3), dtype=np.uint8)) for k in range(FRAMES)
    ]
    wall = np.full((32, 64), 2.5, np.float32)
    wall[24:] = 0  # as where an image shows what is fixed to its camera
    keyframes = [Keyframe.of(frame, wall, spill_file) for frame in frames]
    drive = Drive(Measured(keyframes=keyframes, roads=[None] * FRAMES))
    T_world_camera = np.tile(np.eye(4), (FRAMES, 1, 1))
    T_world_camera[:, 0, 3] = step * np.arange(FRAMES)
    scale = np.full(FRAMES, 2.0)
    return keyframe_depths(drive, scale, T_world_camera, CAMERA, decide, guess_sigma)


def test_what_no_neighbour_measures_has_the_sigma_of_a_guess():
    standing = depths(0.0, guess_sigma=0.32)(2)
    assert standing.relative_sigma is not None
    np.testing.assert_allclose(standing.relative_sigma, 0.32)
    moving = depths(0.4, guess_sigma=0.32)(2)
    assert moving.relative_sigma is not None and moving.relative_sigma.min() != pytest.approx(0.32)


def sure(measurement: Measurement) -> RefinedDepth:
    depth = measurement.depth
    return RefinedDepth(depth, np.full_like(depth, 0.1), np.ones(depth.shape, bool))


def test_what_is_fixed_to_the_camera_is_unknown_whatever_its_neighbours_say():
    sigma = depths(0.4, None, sure)(2).relative_sigma
    assert sigma is not None and np.isinf(sigma[24:]).all()
    np.testing.assert_allclose(sigma[:24], 0.1)


@pytest.mark.parametrize(
    ("guess_sigma", "decide", "farther", "kept"), [(None, sure, 4.0, 2.0), (0.32, None, 0.5, 0.5)]
)
def test_depth_that_is_not_measured_has_no_sigma_and_half_of_what_makes_it_farther(
    monkeypatch, guess_sigma, decide, farther, kept
):
    monkeypatch.setattr(DepthError, "corrected", lambda _, depth: farther * depth)
    standing = depths(0.0, guess_sigma, decide)(2)
    assert standing.relative_sigma is None
    np.testing.assert_allclose(standing.depth[:24], 5.0 * kept, rtol=1e-6)
