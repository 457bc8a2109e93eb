"""Measured structure against the simulated world, whose depth and motion are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from erfsfm.labels.road import on_road, road_plane, under_road
from erfsfm.labels.structure import TeacherStructure, measure_structure
from erfsfm.mvs.flow import rays
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet


@pytest.fixture(scope="module")
def street() -> SimulatedStreet:
    return SimulatedStreet(SimulationOptions(frames=250, seed=702))


@pytest.fixture(scope="module")
def measured(street) -> dict[int, TeacherStructure]:
    K = street.K.astype(np.float32)
    return {i: measure_structure([street.render(k).image for k in range(i - 2, i + 3)], K) for i in (40, 120, 200)}


def test_depth_of_a_street_is_within_a_tenth_up_to_scale(street, measured):
    scales = []
    for index, seen in measured.items():
        truth = street.render(index).depth
        least, most = seen.least.astype(float), seen.most.astype(float)
        sure = (least > 0) & (most < 1.5 * least) & (truth > 0) & (truth < 80)
        assert sure.mean() > 0.3
        depth = 1 / np.sqrt(least[sure] * most[sure])
        scale = np.median(truth[sure] / depth)
        assert np.median(np.abs(scale * depth - truth[sure]) / truth[sure]) < 0.1
        scales.append(scale)
    assert np.median(scales) == pytest.approx(street.camera_height_m, rel=0.12)


def test_motion_is_right_in_rotation_direction_and_relative_length(street, measured):
    for index, seen in measured.items():
        sources = [index + k for k in (-2, -1, 1, 2)]
        true = np.linalg.inv(street.T_world_camera[sources]) @ street.T_world_camera[index]
        difference = Rotation.from_matrix(seen.T_source_target[:, :3, :3]).inv() * Rotation.from_matrix(true[:, :3, :3])
        assert np.rad2deg(difference.magnitude()).max() < 0.5
        lengths = np.linalg.norm(true[:, :3, 3], axis=1) / np.linalg.norm(seen.T_source_target[:, :3, 3], axis=1)
        assert np.ptp(lengths) / lengths.mean() < 0.1


def test_a_camera_at_rest_has_no_motion_and_no_depth_bounds(street):
    image = street.render(0).image
    seen = measure_structure([image] * 5, street.K.astype(np.float32))
    np.testing.assert_array_equal(seen.T_source_target, np.tile(np.eye(4), (4, 1, 1)))
    assert not seen.least.any() and np.isinf(seen.most).all()


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
