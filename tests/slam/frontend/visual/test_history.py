"""The usual direction of motion, sudden losses of inliers, and possible speeds of a car."""

from __future__ import annotations

import numpy as np
import pytest

from slam.frontend.visual.history import AXIS_SIGMA, MotionHistory
from slam.geometry.multiview import UnitRelativePose


def heading(aside_deg: float) -> UnitRelativePose:
    aside = np.deg2rad(aside_deg)
    return UnitRelativePose(np.eye(3), np.array([np.sin(aside), 0.0, -np.cos(aside)]))


def history_of(asides_deg: np.ndarray, speed: float = 6.0) -> MotionHistory:
    history = MotionHistory()
    for aside_deg in asides_deg:
        history = history.with_step(heading(aside_deg), 0.9, speed)
    return history


def test_few_steps_give_no_usual_direction():
    prior = history_of(np.zeros(9)).prior()
    assert prior.axis_sigma == np.inf
    np.testing.assert_array_equal(prior.axis, np.zeros(3))


def test_the_usual_direction_and_its_sigma_are_those_of_the_steps():
    asides = 3.0 + 15.0 * np.random.default_rng(0).normal(size=90)
    asides[::30] = 80.0  # slides
    prior = history_of(asides).prior()
    assert np.rad2deg(np.arctan2(prior.axis[0], -prior.axis[2])) == pytest.approx(3.0, abs=4.0)
    assert np.rad2deg(prior.axis_sigma) == pytest.approx(np.hypot(15.0, 8.0), rel=0.3)
    assert history_of(np.zeros(20)).prior().axis_sigma == pytest.approx(AXIS_SIGMA)


def test_only_the_last_steps_are_kept():
    history = history_of(np.concatenate([np.full(50, 30.0), np.zeros(100)]))
    assert len(history.directions) == 100
    np.testing.assert_allclose(history.directions[0], heading(0.0).direction)


def test_a_step_that_loses_a_third_of_its_inliers_is_noticed():
    history = history_of(np.zeros(20))
    assert history.is_sudden_loss(0.55) and not history.is_sudden_loss(0.65)
    assert not history_of(np.zeros(5)).is_sudden_loss(0.1)


def test_a_car_brakes_with_no_more_than_ten_metres_a_second_squared():
    history = history_of(np.zeros(20), speed=6.0)  # camera heights a second, 10 m/s
    assert history.is_possible_speed(5.0, 0.1) and history.is_possible_speed(7.0, 0.1)
    assert history.is_possible_speed(2.5, 0.1) is False
    assert history.is_possible_speed(2.5, 0.5)
    assert history_of(np.zeros(2)).is_possible_speed(2.5, 0.1) is None
    assert history_of(np.zeros(20), speed=np.nan).is_possible_speed(2.5, 0.1) is None
