"""Accuracy and completeness of a map, by hand values."""

from __future__ import annotations

import numpy as np
import pytest

from slam import se3
from slam.evaluation.map import accuracy_median_m, completeness, pose_similarity, visible_surface
from slam.se3 import FloatArray


def test_accuracy_is_the_median_distance() -> None:
    points = np.array([[0.0, 0.1, 0.0], [1.0, -0.2, 3.0], [2.0, 9.0, 1.0]])
    assert accuracy_median_m(points, lambda p: np.abs(p[:, 1])) == pytest.approx(0.2)
    assert accuracy_median_m(np.empty((0, 3)), lambda p: p[:, 1]) is None


def test_completeness_is_the_ratio_within_30_cm() -> None:
    surface = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    found = np.array([[0.0, 0.29, 0.0], [1.0, 0.31, 0.0], [3.0, 0.0, 0.1], [9.0, 9.0, 9.0]])
    assert completeness(surface, found) == pytest.approx(0.5)
    assert completeness(surface, np.empty((0, 3))) == 0.0
    assert completeness(np.empty((0, 3)), found) is None


def test_visible_surface_is_near_and_in_the_world() -> None:
    K = np.array([[50.0, 0, 10.0], [0, 50.0, 5.0], [0, 0, 1]])
    depth = np.full((11, 21), 8.0)
    depth[:, 0] = 0.0  # nothing there
    depth[:, 20] = 20.0  # a ray longer than 20 m
    T_world_camera = se3.from_rotation_vector(np.array([0.0, np.pi / 2, 0.0]), np.array([1.0, 2.0, 3.0]))
    points = visible_surface(depth, K, T_world_camera, step=5)
    assert points.shape == (3 * 3, 3)
    # the camera looks along +x of the world: its own x axis is -z there
    np.testing.assert_allclose(points[:, 0], 9.0)
    assert [9.0, 2.0, 3.0] in points.round(9).tolist()
    np.testing.assert_allclose(sorted(set(points[:, 2].round(9))), [2.2, 3.0, 3.8])


def drive(frames: int = 40) -> FloatArray:
    step = se3.from_rotation_vector(np.array([0.0, 0.05, 0.0]), np.array([0.0, 0.0, 1.0]))
    return se3.chain(np.tile(step, (frames - 1, 1, 1)))


def test_similarity_undoes_one() -> None:
    truth = drive()
    moved = se3.Similarity(0.2, se3.from_rotation_vector(np.array([0.3, -1.0, 0.2]), np.zeros(3))[:3, :3], np.ones(3))
    back = pose_similarity(truth, moved.apply_to_poses(truth))
    assert back.scale == pytest.approx(5.0)
    np.testing.assert_allclose(back.apply_to_poses(moved.apply_to_poses(truth)), truth, atol=1e-9)


def test_similarity_keeps_the_roll_of_a_straight_road() -> None:
    """Positions on a line do not determine it; orientations do."""
    rng = np.random.default_rng(0)
    truth = np.tile(np.eye(4), (50, 1, 1))
    truth[:, 2, 3] = np.arange(50)
    noisy = truth @ se3.from_rotation_vector(0.005 * rng.normal(size=(50, 3)), 0.05 * rng.normal(size=(50, 3)))
    roll = se3.rotation_angle(pose_similarity(truth, noisy).R_a_b)
    assert roll < np.deg2rad(0.3)


def test_similarity_of_an_estimate_that_stands_still_keeps_its_scale() -> None:
    assert pose_similarity(drive(), np.tile(np.eye(4), (40, 1, 1))).scale == 1.0
