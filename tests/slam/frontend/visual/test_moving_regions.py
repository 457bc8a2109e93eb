"""Which corners learned depth may cast out as moving, and which weigh less because many were outliers recently."""

from __future__ import annotations

import numpy as np

from slam.frontend.visual.moving_regions import DynamicMask, moving_corners

RNG = np.random.default_rng(0)
SCENE = RNG.uniform([0, 0], [1200, 370], (300, 2))
CAR = RNG.uniform([600, 180], [700, 250], (20, 2))
PIXELS = np.concatenate([SCENE, CAR])
OF_CAR = np.arange(len(PIXELS)) >= len(SCENE)
EXPECTED = np.concatenate([RNG.uniform(1, 15, len(SCENE)), np.full(len(CAR), 8.0)])


def test_a_connected_region_of_one_motion_moves() -> None:
    seen = np.where(OF_CAR, 0.3 * EXPECTED, EXPECTED)
    moving = moving_corners(PIXELS, PIXELS[:, 1] > 300, ~OF_CAR, OF_CAR, EXPECTED, seen)
    np.testing.assert_array_equal(moving, OF_CAR)


def test_the_majority_of_the_parallax_does_not_move() -> None:
    """Learned depth agrees with the far corners, which are many: the near ones are the scene all the same."""
    near = PIXELS[:, 1] > 240
    expected = np.where(near, 8.0, 1.0)
    seen = np.where(near, 20.0, 1.0)
    moving = moving_corners(PIXELS, np.zeros(len(PIXELS), bool), ~near, near, expected, seen)
    assert not moving.any()


def test_the_majority_of_the_road_does_not_move() -> None:
    on_road = OF_CAR | (np.arange(len(PIXELS)) < 10)
    seen = np.where(OF_CAR, 0.3 * EXPECTED, EXPECTED)
    moving = moving_corners(PIXELS, on_road & OF_CAR, ~OF_CAR, OF_CAR, EXPECTED, seen)
    assert not moving.any()


def test_corners_that_contradict_each_other_do_not_move() -> None:
    seen = EXPECTED.copy()
    seen[OF_CAR] = EXPECTED[OF_CAR] * np.resize([0.3, 1.7], len(CAR))
    moving = moving_corners(PIXELS, np.zeros(len(PIXELS), bool), ~OF_CAR, OF_CAR, EXPECTED, seen)
    assert not moving.any()


PLACE = np.array([300.0, 70.0])  # of a car


def mask_with_car(steps: int) -> tuple[DynamicMask, np.ndarray]:
    """One in five corners near ``PLACE`` are inliers, nine in ten of the static scene (their pixels are returned)."""
    dynamic_mask = DynamicMask.empty(416, 128)
    static = RNG.uniform([0.0, 0.0], [240.0, 127.0], (150, 2))
    for _ in range(steps):
        car = PLACE + RNG.uniform(-12.0, 12.0, (15, 2))
        is_inlier = np.concatenate([RNG.random(150) < 0.9, RNG.random(15) < 0.2])
        dynamic_mask = dynamic_mask.updated(np.concatenate([static, car]), is_inlier)
    return dynamic_mask, static


def test_corners_on_a_moving_car_are_weighted_down() -> None:
    dynamic_mask, static = mask_with_car(8)
    assert dynamic_mask.weights(PLACE[None]) < 0.05
    assert np.median(dynamic_mask.weights(static)) > 0.8
    assert dynamic_mask.weights(np.array([[400.0, 10.0]])) > 0.8  # no corner was there


def test_outliers_decay_after_the_car_has_left() -> None:
    dynamic_mask, static = mask_with_car(8)
    for _ in range(40):
        pixels = np.concatenate([static, np.tile(PLACE, (3, 1))])
        dynamic_mask = dynamic_mask.updated(pixels, np.ones(153, dtype=bool))
    assert dynamic_mask.weights(PLACE[None]) > 0.8


def test_corners_beyond_the_edge_belong_to_the_nearest_cell() -> None:
    empty = DynamicMask.empty(416, 128)
    dynamic_mask = empty.updated(np.array([[416.0, 128.0], [-0.4, -0.4]]), np.array([True, False]))
    assert np.isfinite(dynamic_mask.weights(np.array([[416.0, 128.0], [-0.4, 0.0]]))).all()
    assert dynamic_mask.corners[-1, -1] == dynamic_mask.inliers[-1, -1] == dynamic_mask.corners[0, 0] == 1.0
    assert dynamic_mask.inliers[0, 0] == 0.0
