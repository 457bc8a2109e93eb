"""Rigid transforms: identities, round trips, hand values, and angles at both ends."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.geometry import se3
from slam.geometry.se3 import FloatArray

QUARTER_ABOUT_Z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def random_poses(rng: np.random.Generator, count: int) -> FloatArray:
    return se3.make(
        Rotation.random(count, rng=rng).as_matrix(), rng.normal(scale=10.0, size=(count, 3))
    )


def test_make_and_apply_hand_value():
    T_a_b = se3.make(QUARTER_ABOUT_Z, np.array([10.0, 20.0, 30.0]))
    points_a = se3.apply(T_a_b, np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_array_equal(points_a, [[8.0, 21.0, 33.0], [10.0, 20.0, 30.0]])


def test_invert_undoes_and_keeps_stacks(rng: np.random.Generator):
    T_a_b = random_poses(rng, 12).reshape(3, 4, 4, 4)
    np.testing.assert_allclose(
        se3.invert(T_a_b) @ T_a_b, np.broadcast_to(np.eye(4), T_a_b.shape), atol=1e-14
    )
    np.testing.assert_allclose(se3.invert(se3.invert(T_a_b)), T_a_b, atol=1e-14)


def test_what_is_predicted_from_its_own_predictions_stays_rigid():
    step = se3.from_rotation_vector(np.array([0.01, 0.02, -0.03]), np.array([0.1, 0.0, 0.2]))
    before, now = np.eye(4), step
    for _ in range(1000):
        before, now = now, se3.compose(now, se3.invert(before) @ now)
    assert se3.is_se3(now, tolerance=1e-12)


def test_chain_rebuilds_poses_from_their_increments(rng: np.random.Generator):
    T_first_k = random_poses(rng, 8)
    T_first_k = se3.invert(T_first_k[0]) @ T_first_k
    increments = se3.invert(T_first_k[:-1]) @ T_first_k[1:]
    np.testing.assert_allclose(se3.chain(increments), T_first_k, atol=1e-12)
    np.testing.assert_array_equal(se3.chain(np.zeros((0, 4, 4))), np.eye(4)[None])


@pytest.mark.parametrize(
    "angle", [0.0, 1e-12, 1e-8, 1e-3, 1.0, math.pi / 2, math.pi - 1e-6, math.pi]
)
def test_rotation_angle_at_both_ends(angle: float):
    axis = np.array([2.0, 3.0, -6.0]) / 7.0
    R = se3.from_rotation_vector(angle * axis, np.zeros(3))[:3, :3]
    assert float(se3.rotation_angle(R)) == pytest.approx(angle, rel=1e-12, abs=1e-15)


def test_from_rotation_vector_hand_value():
    T_a_b = se3.from_rotation_vector(np.array([0.0, 0.0, math.pi / 2]), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(
        T_a_b, se3.make(QUARTER_ABOUT_Z, np.array([1.0, 2.0, 3.0])), atol=1e-15
    )


def test_nearest_rotation_keeps_rotations_and_repairs_stacks(rng: np.random.Generator):
    R = Rotation.random(6, rng=rng).as_matrix().reshape(2, 3, 3, 3)
    np.testing.assert_allclose(se3.nearest_rotation(R), R, atol=1e-14)
    stretched = R @ np.diag([1.01, 0.99, 1.02])
    assert se3.is_se3(se3.make(se3.nearest_rotation(stretched), np.zeros((2, 3, 3))))
    np.testing.assert_allclose(se3.nearest_rotation(1.7 * R[0, 0]), R[0, 0], atol=1e-14)


@pytest.mark.parametrize("scale", [1.0, 0.03, 42.0])
def test_umeyama_finds_a_known_similarity(rng: np.random.Generator, scale: float):
    points_b = rng.normal(size=(20, 3))
    R_a_b, t_a_b = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    fit = se3.umeyama(scale * points_b @ R_a_b.T + t_a_b, points_b, with_scale=True)
    assert fit.scale == pytest.approx(scale, rel=1e-12)
    np.testing.assert_allclose(fit.R_a_b, R_a_b, atol=1e-12)
    np.testing.assert_allclose(fit.t_a_b, t_a_b, atol=1e-11)


def test_umeyama_without_scale_agrees_with_kabsch(rng: np.random.Generator):
    points_a, points_b = rng.normal(size=(2, 30, 3))
    fit = se3.umeyama(points_a, points_b, with_scale=False)
    kabsch, _ = Rotation.align_vectors(
        points_a - points_a.mean(axis=0), points_b - points_b.mean(axis=0)
    )
    assert fit.scale == 1.0
    np.testing.assert_allclose(fit.R_a_b, kabsch.as_matrix(), atol=1e-10)


def test_umeyama_of_a_planar_path_is_no_mirror_image(rng: np.random.Generator):
    points_b = rng.normal(size=(10, 3)) * [1.0, 0.0, 1.0]
    R_a_b = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    np.testing.assert_allclose(
        se3.umeyama(points_b @ R_a_b.T, points_b, True).R_a_b, R_a_b, atol=1e-12
    )


def test_a_similarity_moves_poses_as_it_moves_their_positions(rng: np.random.Generator):
    T_b_k = random_poses(rng, 5)
    turn = Rotation.random(rng=rng).as_matrix()
    T_a_k = se3.Similarity(3.0, turn, np.array([1.0, 2.0, 3.0])).apply_to_poses(T_b_k)
    np.testing.assert_allclose(T_a_k[:, :3, 3], 3.0 * T_b_k[:, :3, 3] @ turn.T + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(T_a_k[:, :3, :3], turn @ T_b_k[:, :3, :3])
