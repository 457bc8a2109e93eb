"""Labels from many views and from refined learned depth against the simulated world, whose truth is exact."""

from __future__ import annotations

import functools
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from erfsfm.labels import (
    NEIGHBOURS,
    Array,
    combine,
    direction_of_travel,
    in_camera_heights,
    label,
    measure,
    on_road,
    rays,
    refined_label,
    road_plane,
    shrunk,
    sky_mask,
    triangulate,
    under_road,
)
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

FRAME, NEAR = 60, (-1, 1, 3)


@cache
def long_street() -> SimulatedStreet:
    return SimulatedStreet(SimulationOptions(frames=250, seed=703))


@cache
def grey(frame: int) -> NDArray[np.uint8]:
    return long_street().render(frame).image[..., 1].copy()


def seen(
    frame: int, others: tuple[int, ...]
) -> tuple[NDArray[np.uint8], list[NDArray[np.uint8]], Array, Array]:
    """A frame, its neighbours, their camera, and ``T_neighbour_target`` in camera heights."""
    T = (
        np.linalg.inv(long_street().T_world_camera[[frame + k for k in others]])
        @ long_street().T_world_camera[frame]
    )
    T[:, :3, 3] /= long_street().camera_height_m
    return grey(frame), [grey(frame + k) for k in others], long_street().K, T


@cache
def by_flow(frame: int) -> tuple[Array, Array]:
    return label(*seen(frame, NEIGHBOURS))


@cache
def truth(frame: int) -> Array:
    """Inverse depth in camera heights, 0 where it is unknown."""
    depth = long_street().depth(frame)
    return np.where(depth > 0, long_street().camera_height_m / np.maximum(depth, 1e-6), 0).astype(
        np.float32
    )


def errors(bounds: tuple[Array, Array], true: Array) -> tuple[Array, float]:
    """Relative errors where the bounds are narrow, and the share of these pixels."""
    least, most = bounds
    narrow = (least > 0) & (most < 1.5 * least) & (true > 0)
    return np.abs(np.sqrt(least[narrow] * most[narrow]) / true[narrow] - 1), float(narrow.mean())


def test_bounds_are_narrow_in_camera_heights_and_hold_the_truth() -> None:
    (least, most), true = by_flow(FRAME), truth(FRAME)
    error, known = errors((least, most), true)
    assert known > 0.4 and np.median(error) < 0.03
    narrow = (least > 0) & (most < 1.5 * least) & (true > 0)
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


def test_more_is_known_than_by_flow_alone_and_it_is_as_right() -> None:
    network = 7 * cv2.GaussianBlur(truth(FRAME), (0, 0), 4) ** np.float32(0.9) + np.float32(
        0.05
    )  # in its own unit
    learned = in_camera_heights(network, *measure(*seen(FRAME, NEIGHBOURS)))
    assert learned is not None
    bounds = refined_label(*seen(FRAME, NEAR), learned)
    refined, known = errors(bounds, truth(FRAME))
    plain, known_by_flow = errors(by_flow(FRAME), truth(FRAME))
    assert known > known_by_flow + 0.1
    assert refined.mean() < plain.mean() + 0.005
    least, most = bounds
    both = (least > 0) & np.isfinite(most) & (truth(FRAME) > 0)
    between = (0.98 * least[both] <= truth(FRAME)[both]) & (truth(FRAME)[both] <= 1.02 * most[both])
    assert between.mean() > 0.8


def test_the_unit_of_learned_depth_may_be_off_in_a_frame() -> None:
    exact, middles = np.maximum(truth(FRAME), np.float32(0.008)), []
    for unit in (0.8, 1.0, 1.25):
        error, known = errors(
            refined_label(*seen(FRAME, NEAR), np.float32(unit) * exact), truth(FRAME)
        )
        assert known > 0.5
        middles.append(np.median(error))
    assert max(middles) < 0.02


def test_no_scale_where_flow_measures_nothing() -> None:
    blank = np.full((64, 128), 120, np.uint8)
    _, _, K, T_neighbour_target = seen(FRAME, (-1, 1))
    measured = measure(blank, [blank] * 2, K, T_neighbour_target)
    assert in_camera_heights(np.ones((64, 128), np.float32), *measured) is None


def test_a_smaller_label_is_wide_at_edges_and_unknown_where_a_pixel_is():
    least = np.full((2, 6), 0.2, np.float32)
    most = np.full((2, 6), 0.22, np.float32)
    least[:, 3], most[:, 3] = 0.02, 0.022  # a surface ten times as far in half of a block
    least[0, 5] = 0
    low, high = shrunk(least, most, 2)
    np.testing.assert_allclose([low[0, 0], high[0, 0]], [0.2, 0.22], rtol=1e-5)
    assert low[0, 1] < 0.021
    assert high[0, 1] > 0.21
    assert low[0, 2] == 0
    np.testing.assert_allclose(high[0, 2], 0.22, rtol=1e-5)


def test_height_over_a_known_plane_with_a_car_on_it():
    K = np.array([[240, 0, 208], [0, 240, 60], [0, 0, 1]], np.float32)
    p = rays(128, 416, K)
    down = Rotation.from_euler("x", 3, degrees=True).apply([0, 1, 0])
    inverse_depth = (p @ down / 1.6).astype(np.float32)
    forward = Rotation.from_euler("x", 3, degrees=True).apply([0, 0, 1])
    inverse_depth[85:105, 180:240] = 0.2
    plane = road_plane(inverse_depth, inverse_depth > 0, p, forward)
    assert plane is not None and 1 / np.linalg.norm(plane) == pytest.approx(1.6, rel=0.01)


def test_the_road_is_filled_where_nothing_was_measured_but_not_under_a_car():
    K = np.array([[240, 0, 208], [0, 240, 60], [0, 0, 1]], np.float32)
    p = rays(128, 416, K)
    road = (p @ np.array([0, 1, 0]) / 1.6).astype(np.float32)
    inverse_depth = road.copy()
    inverse_depth[:64] = 0.05
    inverse_depth[70:112, 60:140] = 0.25
    known = np.ones(road.shape, bool)
    known[112:] = False
    level = on_road(inverse_depth, known, road)
    assert level[120, 200:300].all() and level[95, 200:300].all()
    assert not level[:62].any() and not level[70:88, 80:120].any()


def test_a_car_at_the_cameras_speed_gets_no_far_depth():
    """Ahead at our own speed it does not move in the image, as if it were infinitely far."""
    K = np.array([[240, 0, 208], [0, 240, 60], [0, 0, 1]], np.float32)
    road = (rays(128, 416, K) @ np.array([0, 1, 0]) / 1.6).astype(np.float32)
    inverse_depth = np.maximum(road, 0.02)
    inverse_depth[70:90, 190:230] = 0.002
    sigma = np.full(road.shape, 0.005, np.float32)
    under = under_road(inverse_depth, sigma, road)
    assert under[75:88, 192:228].all()
    assert not under[:66].any() and not under[95:].any() and not under[:, :180].any()


@pytest.fixture(scope="module")
def street() -> SimulatedStreet:
    street = SimulatedStreet(SimulationOptions(frames=250, seed=702, width=312, height=96))
    street.render = functools.cache(street.render)
    return street


def _measured(street, index, neighbours, error=None):
    T = np.linalg.inv(street.T_world_camera[neighbours]) @ street.T_world_camera[index]
    if error is not None:
        T = error @ T
    grey = [street.render(k).image[..., 1].copy() for k in (index, *neighbours)]
    return measure(grey[0], grey[1:], street.K, T, fine=True)


@pytest.mark.parametrize("index", [40, 120])
def test_depth_is_metric_and_its_sigma_tells_where_it_is_known(street, index):
    inverse_depth, sigma = _measured(street, index, [index + k for k in (-4, -2, -1, 1, 2, 4)])
    truth = street.render(index).depth
    known = np.isfinite(sigma) & (truth > 0) & (truth < 80) & (sigma < 0.2 * inverse_depth)
    assert known.mean() > 0.3
    error = np.abs(inverse_depth[known] * truth[known] - 1)
    assert np.median(error) < 0.04


def test_wrong_poses_leave_little_that_seems_known(street):
    turned = np.eye(4)
    turned[:3, :3] = np.array(
        [[1, 0, 0.0], [0, np.cos(0.02), -np.sin(0.02)], [0, np.sin(0.02), np.cos(0.02)]]
    )
    neighbours = [120 + k for k in (-4, -2, -1, 1, 2, 4)]
    (_, right), (_, wrong) = (
        _measured(street, 120, neighbours),
        _measured(street, 120, neighbours, turned),
    )
    assert np.isfinite(wrong).mean() < 0.5 * np.isfinite(right).mean()


def test_a_flow_made_from_a_depth_gives_that_depth_back():
    K = np.array([[240, 0, 208], [0, 240, 60], [0, 0, 1.0]])
    T = np.eye(4)
    T[:3, 3] = [0.1, -0.05, -1.0]
    inverse_depth = np.full((128, 416), 1 / 12, np.float32)
    p = rays(128, 416, K)
    moved = p + inverse_depth[..., None] * T[:3, 3].astype(np.float32)
    flow = np.stack([240 * (moved[..., k] / moved[..., 2] - p[..., k]) for k in range(2)], axis=-1)
    got, sigma, off_line_px = triangulate(flow.astype(np.float32), T, K)
    away = np.hypot(p[..., 0] + 0.1, p[..., 1] - 0.05) > 0.1  # from the focus of expansion
    np.testing.assert_allclose(got[away], 1 / 12, rtol=2e-3)
    assert off_line_px.max() < 0.02 and sigma[away].max() < sigma.max()


def test_a_lone_outlier_is_left_out_and_one_view_alone_is_not_believed():
    values = np.array([0.1, 0.101, 0.5, 0.1], np.float32).reshape(4, 1, 1) * np.ones(
        (4, 1, 2), np.float32
    )
    sigmas = np.full((4, 1, 2), 0.002, np.float32)
    sigmas[:3, 0, 1] = np.inf
    inverse_depth, sigma = combine(values, sigmas)
    assert inverse_depth[0, 0] == pytest.approx(0.1003, rel=1e-2)
    assert np.isfinite(sigma[0, 0]) and np.isinf(sigma[0, 1])
