"""The error of learned depth over distance, measured against triangulated depth."""

from __future__ import annotations

import numpy as np
import pytest

from slam.frontend.visual.depth_error import DepthError
from slam.geometry.multiview import UnitRelativePose, triangulated_nearness

NOISE_PX = 0.2


def biased(depth: np.ndarray) -> np.ndarray:
    """Depth as a network that sees far things too near: by 35 % beyond 40 m."""
    return depth * np.exp(np.interp(np.log(depth), np.log([15.0, 40.0]), [0.0, np.log(0.65)]))


def street(rng: np.random.Generator, far: int, near: int) -> np.ndarray:
    return np.concatenate([rng.uniform(40.0, 90.0, far), rng.uniform(5.0, 15.0, near)])


def after_steps(steps: int, far: int, near: int, seed: int = 0) -> tuple[DepthError, list[float]]:
    """The error after some steps of a metre, and the lengths by learned depth."""
    rng = np.random.default_rng(seed)
    error, lengths = DepthError(), []
    for _ in range(steps):
        depth = street(rng, far, near)
        learned = biased(depth) * np.exp(0.1 * rng.normal(size=len(depth)))
        radius_px = rng.uniform(30.0, 400.0, len(depth))
        parallax = radius_px / depth + NOISE_PX * rng.normal(size=len(depth))
        nearness = parallax / radius_px  # the step is one metre
        solid = parallax > 2.0
        sigma = NOISE_PX / parallax[solid]
        length, _ = error.length(learned[solid], 1.0 / nearness[solid], sigma)
        error = error.with_step(learned, nearness, NOISE_PX / radius_px, length)
        lengths.append(length)
    return error, lengths


def test_the_bias_over_distance_is_found_and_taken_out():
    error, _ = after_steps(80, far=400, near=200)
    depth = np.array([8.0, 12.0, 50.0, 70.0])
    ratio = error.corrected(biased(depth)) / depth
    np.testing.assert_allclose(ratio / ratio[0], 1.0, atol=0.1)


def test_the_curve_has_the_distances_that_were_seen():
    np.testing.assert_allclose(
        DepthError().corrected(np.array([1.0, 200.0, np.nan])), [1.0, 200.0, np.nan]
    )
    assert DepthError().curve() == []
    error, _ = after_steps(80, far=400, near=200)
    depths, biases, sigmas, corners = zip(*error.curve(), strict=True)
    assert 4.0 <= min(depths) < 8.0 and 32.0 <= max(depths) <= 64.0
    assert biases[0] - min(biases) > 0.3 and max(sigmas) < 0.3 and min(corners) > 40


def test_the_length_does_not_depend_on_how_many_corners_are_far():
    """A road with trees, then a plain: the network's own bias would shorten the steps by a third."""
    for far, near in ((50, 400), (500, 60)):
        _, lengths = after_steps(80, far, near)
        assert np.std(np.log(lengths[20:])) < 0.05


def test_moving_objects_in_a_tenth_of_the_corners_leave_the_bias_as_it_is():
    rng = np.random.default_rng(1)
    error = DepthError()
    for _ in range(60):
        depth = street(rng, 200, 200)
        factor = np.where(rng.random(400) < 0.1, 3.0, 1.0)
        error = error.with_step(depth, factor / depth, 0.0 * depth, 1.0)
    np.testing.assert_allclose(error.corrected(np.array([8.0, 60.0])), [8.0, 60.0], rtol=0.05)


@pytest.mark.parametrize("noise_px", [0.1, 0.3])
def test_short_steps_do_not_bias_far_depth_nor_widen_its_sigma(noise_px: float):
    """Steps of half a metre past points of 4 to 200 m, whose learned depth scatters by 15 % around its own unit."""
    rng, ahead, focal_px = (
        np.random.default_rng(0),
        UnitRelativePose(np.eye(3), np.array([0.0, 0.0, -1.0])),
        360.0,
    )
    error, length = DepthError(), 0.5
    for _ in range(80):
        depth = np.exp(rng.uniform(np.log(4.0), np.log(200.0), 600))
        before = np.column_stack(
            [rng.uniform(-0.8, 0.8, 600), rng.uniform(-0.25, 0.25, 600), np.ones(600)]
        )
        after = before * depth[:, None] + length * ahead.direction
        after /= after[:, 2:]
        after[:, :2] += rng.normal(0.0, noise_px / focal_px, (600, 2))
        nearness, per_ray = triangulated_nearness(before, after, ahead)
        learned = depth * np.exp(0.15 * rng.normal(size=600))
        error = error.with_step(learned, nearness, noise_px / focal_px * per_ray, length)
    far = np.array([10.0, 20.0, 40.0, 60.0, 80.0])
    ratio = error.corrected(far) / far
    np.testing.assert_allclose(ratio / ratio[0], 1.0, atol=0.02)
    np.testing.assert_allclose(error.sigma(far), 0.15, atol=0.03)
