"""The error of learned depth over distance, measured against triangulated depth."""

from __future__ import annotations

import numpy as np

from slam.frontend.visual.depth_error import DepthError

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
        error = error.with_step(learned, nearness, length)
        lengths.append(length)
    return error, lengths


def test_depth_without_observations_is_as_the_network_gives_it() -> None:
    depth = np.array([1.0, 10.0, 200.0, np.nan])
    np.testing.assert_allclose(DepthError().corrected(depth), depth)


def test_the_bias_over_distance_is_found_and_taken_out() -> None:
    error, _ = after_steps(80, far=400, near=200)
    depth = np.array([8.0, 12.0, 50.0, 70.0])
    ratio = error.corrected(biased(depth)) / depth
    np.testing.assert_allclose(ratio / ratio[0], 1.0, atol=0.1)


def test_the_curve_has_the_distances_that_were_seen() -> None:
    assert DepthError().curve() == []
    error, _ = after_steps(80, far=400, near=200)
    depths, biases, sigmas, corners = zip(*error.curve(), strict=True)
    assert 4.0 <= min(depths) < 8.0 and 32.0 <= max(depths) <= 64.0
    assert biases[0] - min(biases) > 0.3 and max(sigmas) < 0.3 and min(corners) > 40


def test_the_length_does_not_depend_on_how_many_corners_are_far() -> None:
    """A road with trees, then a plain: the network's own bias would shorten the steps by a third."""
    for far, near in ((50, 400), (500, 60)):
        _, lengths = after_steps(80, far, near)
        assert np.std(np.log(lengths[20:])) < 0.05


def test_moving_objects_in_a_tenth_of_the_corners_leave_the_bias_as_it_is() -> None:
    rng = np.random.default_rng(1)
    error = DepthError()
    for _ in range(60):
        depth = street(rng, 200, 200)
        factor = np.where(rng.random(400) < 0.1, 3.0, 1.0)
        error = error.with_step(depth, factor / depth, 1.0)
    np.testing.assert_allclose(error.corrected(np.array([8.0, 60.0])), [8.0, 60.0], rtol=0.05)
