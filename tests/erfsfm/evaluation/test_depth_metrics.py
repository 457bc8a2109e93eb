"""Depth errors by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from erfsfm.evaluation.depth_metrics import (
    depth_errors,
    mean_errors,
    mean_ratio,
    standard_error,
    valid_pixels,
)


def test_perfect_up_to_scale():
    truth = np.random.default_rng(0).uniform(1, 70, (6, 8)).astype(np.float32)
    errors = depth_errors(truth / 7, truth)
    assert errors.scale == pytest.approx(7, rel=1e-6)
    assert errors.abs_rel == pytest.approx(0, abs=1e-6)
    assert errors.rmse == pytest.approx(0, abs=1e-4)
    assert errors.a1 == errors.a2 == errors.a3 == 1


def test_by_hand_without_scaling():
    truth = np.array([[10.0, 20.0, 0.0]], np.float32)
    guess = np.array([[12.0, 10.0, 5.0]], np.float32)
    errors = depth_errors(guess, truth, scaling=1.0)
    assert errors.scale == 1
    assert errors.abs_rel == pytest.approx((0.2 + 0.5) / 2)
    assert errors.sq_rel == pytest.approx((4 / 10 + 100 / 20) / 2)
    assert errors.rmse == pytest.approx(math.sqrt((4 + 100) / 2))
    assert errors.rmse_log == pytest.approx(math.sqrt((math.log(1.2) ** 2 + math.log(2) ** 2) / 2))
    assert (errors.a1, errors.a2, errors.a3) == (0.5, 0.5, 0.5)


def test_scaled_predictions_are_clipped_afterwards():
    truth = np.array([[10.0, 10.0, 79.0]], np.float32)
    guess = np.array([[1.0, 1.0, 1000.0]], np.float32)
    errors = depth_errors(guess, truth)
    assert errors.scale == 10
    assert errors.rmse == pytest.approx(math.sqrt(1 / 3)), "80 against 79, not 10000"


def test_valid_pixels():
    truth = np.full((100, 200), 5.0, np.float32)
    truth[50, 50:53] = [0, 80, 90]
    assert (~valid_pixels(truth, 80, "none")).sum() == 3
    rows, columns = np.nonzero(valid_pixels(np.full((375, 1242), 5.0, np.float32), 80, "garg"))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (153, 370, 44, 1196)


def test_every_image_counts_once():
    truth = np.full((1, 4), 10, np.float32)
    first = depth_errors(truth, truth, scaling=1.0)
    second = depth_errors(truth * 1.5, truth, scaling=1.0)
    assert first is not None
    assert second is not None
    assert mean_errors([first, second]).abs_rel == pytest.approx(0.25)


def test_standard_error_and_ratio_are_those_over_streets():
    assert standard_error([1.0, 3.0]) == pytest.approx(1.0), (
        "a standard deviation of sqrt(2) of two streets"
    )
    assert standard_error([1.0]) is None
    ratio, error = mean_ratio([0.1, 0.4], to=[0.2, 0.2])
    assert ratio == pytest.approx(1.0) and error == pytest.approx(np.log(2))
    assert mean_ratio([0.1], to=[0.2]) == (pytest.approx(0.5), None)
