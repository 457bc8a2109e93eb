"""The road in images whose inverse depth is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from erfsfm.labels.flow_labels import rays
from erfsfm.labels.road import on_road, road_plane, under_road


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
