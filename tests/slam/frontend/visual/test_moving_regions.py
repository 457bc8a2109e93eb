"""Which corners learned depth may cast out as moving."""

from __future__ import annotations

import numpy as np

from slam.frontend.visual.moving_regions import moving_corners

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
