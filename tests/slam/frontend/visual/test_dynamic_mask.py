"""Corners are weighted down where many were outliers recently."""

from __future__ import annotations

import numpy as np
import pytest

from slam.frontend.visual.moving_regions import DynamicMask

CAR = np.array([300.0, 70.0])
RNG = np.random.default_rng(0)


def mask_with_car(steps: int, sharpness: float = 4.0) -> tuple[DynamicMask, np.ndarray]:
    """One in five corners near ``CAR`` are inliers, nine in ten of the static scene (their pixels are returned)."""
    dynamic_mask = DynamicMask.empty(416, 128, sharpness)
    static = RNG.uniform([0.0, 0.0], [240.0, 127.0], (150, 2))
    for _ in range(steps):
        car = CAR + RNG.uniform(-12.0, 12.0, (15, 2))
        is_inlier = np.concatenate([RNG.random(150) < 0.9, RNG.random(15) < 0.2])
        dynamic_mask = dynamic_mask.updated(np.concatenate([static, car]), is_inlier)
    return dynamic_mask, static


def test_corners_on_a_moving_car_are_weighted_down() -> None:
    dynamic_mask, static = mask_with_car(8)
    assert dynamic_mask.weights(CAR[None]) < 0.05
    assert np.median(dynamic_mask.weights(static)) > 0.8
    assert dynamic_mask.weights(np.array([[400.0, 10.0]])) > 0.8  # no corner was there


def test_outliers_decay_after_the_car_has_left() -> None:
    dynamic_mask, static = mask_with_car(8)
    for _ in range(40):
        pixels = np.concatenate([static, np.tile(CAR, (3, 1))])
        dynamic_mask = dynamic_mask.updated(pixels, np.ones(153, dtype=bool))
    assert dynamic_mask.weights(CAR[None]) > 0.8


def test_corners_beyond_the_edge_belong_to_the_nearest_cell() -> None:
    empty = DynamicMask.empty(416, 128, 4.0)
    dynamic_mask = empty.updated(np.array([[416.0, 128.0], [-0.4, -0.4]]), np.array([True, False]))
    assert np.isfinite(dynamic_mask.weights(np.array([[416.0, 128.0], [-0.4, 0.0]]))).all()
    assert dynamic_mask.corners[-1, -1] == dynamic_mask.inliers[-1, -1] == dynamic_mask.corners[0, 0] == 1.0
    assert dynamic_mask.inliers[0, 0] == 0.0


def test_an_update_leaves_the_earlier_mask_as_it_was() -> None:
    dynamic_mask, static = mask_with_car(8)
    before = dynamic_mask.weights(CAR[None])
    updated = dynamic_mask.updated(np.concatenate([static, np.tile(CAR, (9, 1))]), np.ones(159, dtype=bool))
    assert dynamic_mask.weights(CAR[None]) == pytest.approx(before, abs=0.0)
    assert updated.weights(CAR[None]) > 2 * before
