import numpy as np

from slam.frontend.visual.dynamic_mask import DynamicMask

CAR = np.array([300.0, 70.0])
RNG = np.random.default_rng(0)


def watched(steps: int, sharpness: float = 4.0) -> tuple[DynamicMask, np.ndarray]:
    """A car's corners near ``CAR`` fit one time in five, those of the world (returned) nine times in ten."""
    dynamic_mask = DynamicMask(416, 128, sharpness)
    world = RNG.uniform([0.0, 0.0], [240.0, 127.0], (150, 2))
    for _ in range(steps):
        car = CAR + RNG.uniform(-12.0, 12.0, (15, 2))
        fitting = np.concatenate([RNG.random(150) < 0.9, RNG.random(15) < 0.2])
        dynamic_mask.learn(np.concatenate([world, car]), fitting)
    return dynamic_mask, world


def test_who_has_seen_nothing_believes_everything():
    np.testing.assert_array_equal(DynamicMask(416, 128, 4.0).weights(RNG.uniform(0.0, 100.0, (5, 2))), np.ones(5))


def test_a_place_where_corners_move_by_themselves_is_hardly_believed():
    dynamic_mask, world = watched(8)
    assert dynamic_mask.weights(CAR[None]) < 0.05
    assert np.median(dynamic_mask.weights(world)) > 0.8
    assert dynamic_mask.weights(np.array([[400.0, 10.0]])) > 0.8  # where nothing was seen


def test_what_has_left_is_forgotten():
    dynamic_mask, world = watched(8)
    for _ in range(40):
        dynamic_mask.learn(np.concatenate([world, np.tile(CAR, (3, 1))]), np.ones(153, dtype=bool))
    assert dynamic_mask.weights(CAR[None]) > 0.8


def test_no_sharpness_believes_all_alike():
    dynamic_mask, world = watched(8, sharpness=0.0)
    np.testing.assert_array_equal(dynamic_mask.weights(np.concatenate([world, CAR[None]])), np.ones(151))


def test_corners_beyond_the_edge_belong_to_the_edge():
    dynamic_mask = DynamicMask(416, 128, 4.0)
    dynamic_mask.learn(np.array([[416.0, 128.0], [-0.4, -0.4]]), np.array([True, False]))
    assert np.isfinite(dynamic_mask.weights(np.array([[416.0, 128.0], [-0.4, 0.0]]))).all()
