"""The motion prior from accepted motions."""

from __future__ import annotations

import numpy as np
import pytest

from slam.frontend.visual.epipolar import UnitRelativePose
from slam.frontend.visual.motion_history import MotionHistory, usual_error


def heading(aside_deg: float) -> UnitRelativePose:
    aside = np.deg2rad(aside_deg)
    return UnitRelativePose(np.eye(3), np.array([np.sin(aside), 0.0, -np.cos(aside)]))


def history_of(asides_deg: np.ndarray, error: float = 0.1) -> MotionHistory:
    history = MotionHistory()
    for aside_deg in asides_deg:
        history = history.with_step(heading(aside_deg), error)
    return history


def test_a_step_is_kept_as_measured() -> None:
    before = history_of(np.zeros(3))
    after = before.with_step(heading(4.0), 0.2)
    np.testing.assert_array_equal(after.directions[-1], heading(4.0).direction)
    assert after.last is not None
    np.testing.assert_array_equal(after.last.direction, heading(4.0).direction)
    assert after.depth_relative_errors == (0.1, 0.1, 0.1, 0.2)
    assert len(before.directions) == 3  # a history is a value


def test_few_steps_give_no_usual_direction() -> None:
    prior = history_of(np.zeros(9)).prior(0.15, 0.01)
    assert prior.depth_relative_error == 0.15 and prior.axis_sigma == np.inf
    np.testing.assert_array_equal(prior.axis, np.zeros(3))


def test_the_usual_direction_and_its_sigma_are_those_of_the_steps() -> None:
    asides = 3.0 + 2.0 * np.random.default_rng(0).normal(size=90)
    asides[::30] = 80.0  # slides
    prior = history_of(asides).prior(0.15, np.deg2rad(1.0))
    assert np.rad2deg(np.arctan2(prior.axis[0], -prior.axis[2])) == pytest.approx(3.0, abs=1.0)
    assert np.rad2deg(prior.axis_sigma) == pytest.approx(np.hypot(2.0, 1.0), rel=0.3)
    straight = history_of(np.zeros(20)).prior(0.15, np.deg2rad(1.0))
    assert straight.axis_sigma == pytest.approx(np.deg2rad(1.0))


def test_only_the_last_steps_are_kept() -> None:
    history = history_of(np.concatenate([np.full(50, 30.0), np.zeros(100)]))
    assert len(history.directions) == len(history.depth_relative_errors) == 100
    np.testing.assert_allclose(history.directions[0], heading(0.0).direction)


def test_the_usual_error_of_depth_is_a_median_that_ignores_unknown_ones() -> None:
    assert usual_error((), 0.1) == 0.1
    assert usual_error((0.01, 0.02, np.nan), 0.1) == 0.1
    assert usual_error((0.3, 0.5, np.nan, 0.3), 0.1) == 0.3
