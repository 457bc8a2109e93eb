"""Labels from many views against the simulated world, whose depth and poses are exact."""

import functools

import numpy as np

from erfsfm.labels.many_views import direction_of_travel, label, sky_mask
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

NEIGHBOURS = (-4, -2, -1, 1, 2, 4)


@functools.cache
def street() -> SimulatedStreet:
    return SimulatedStreet(SimulationOptions(frames=250, seed=703))


@functools.cache
def images(index):
    return [street().render(index + k).image[..., 1].copy() for k in (0, *NEIGHBOURS)]


def truth(index):
    """Inverse depth in camera heights, 0 where it is unknown."""
    depth = street().depth(index)
    return np.where(depth > 0, street().camera_height_m / np.maximum(depth, 1e-6), 0)


@functools.cache
def measured(index):
    T = np.linalg.inv(street().T_world_camera[[index + k for k in NEIGHBOURS]]) @ street().T_world_camera[index]
    T[:, :3, 3] /= street().camera_height_m
    grey, *others = images(index)
    return label(grey, others, street().K, T)


def test_bounds_are_narrow_in_camera_heights_and_hold_the_truth():
    for index in (60, 150):
        (least, most), true = measured(index), truth(index)
        narrow = (least > 0) & (most < 1.5 * least) & (true > 0)
        assert narrow.mean() > 0.4
        middle = np.sqrt(least[narrow] * most[narrow])
        assert np.median(np.abs(middle / true[narrow] - 1)) < 0.03
        widened = (0.9 * least[narrow] < true[narrow]) & (true[narrow] < 1.1 * most[narrow])
        assert widened.mean() > 0.85


def test_the_sky_is_far_and_nothing_below_the_horizon_is_sky():
    grey = np.full((100, 200), 90, np.uint8)
    grey[:40] = 250
    grey[10:40, 80:90] = 60
    grey[70:80, 50:100] = 250
    sky = sky_mask(grey, (100, 50))
    assert sky[:36, :70].all() and not sky[15:40, 82:88].any() and not sky[50:].any()


def test_a_white_wall_that_reaches_the_ground_is_no_sky():
    grey = np.full((100, 200), 90, np.uint8)
    grey[:70, :76] = 250
    grey[:40, 90:] = 250
    sky = sky_mask(grey, (100, 50))
    assert not sky[:, :86].any() and sky[:36, 94:].all()


def test_direction_of_travel_is_forward_and_unknown_at_rest():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[0, 2, 3], T[1, 2, 3] = 1.0, -1.0  # a point ahead is farther from the camera before
    np.testing.assert_allclose(direction_of_travel(T), [0, 0, 1])
    assert direction_of_travel(np.tile(np.eye(4), (2, 1, 1))) is None
