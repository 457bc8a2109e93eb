"""Perspective-n-point: a known camera is found among outliers, its sigmas hold, and seeds vary the draws.

Two-view geometry of drawn points with a known motion.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.frames import Intrinsics
from slam.geometry import se3
from slam.geometry.multiview import (
    UnitRelativePose,
    consensus,
    depth_in_current,
    parallax_px,
    pixel_jacobian,
    ransac_order,
    resect,
    rotation_between,
    triangulated_depth,
    unit_pose_by_essential,
    unit_pose_by_pnp,
)
from slam.geometry.se3 import (
    FloatArray,
    apply,
    from_rotation_vector,
    invert,
    is_se3,
    rotation_angle,
)

K = np.array([[240.0, 0.0, 160.0], [0.0, 240.0, 60.0], [0.0, 0.0, 1.0]])
T_CAMERA_POINTS = se3.from_rotation_vector(
    np.array([0.02, -0.05, 0.01]), np.array([0.1, -0.05, -0.8])
)
INTRINSICS = Intrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
T_TRUE = from_rotation_vector(np.array([0.1, -0.2, 0.3]), np.array([0.2, 0.1, -0.3]))
FOCAL_PX = 240.0
LENGTH = 0.8
T_CURRENT_PREVIOUS = se3.from_rotation_vector(
    np.deg2rad([0.3, -2.0, 0.2]), LENGTH * np.array([0.28, 0.0, -0.96])
)
UNIT_POSE = UnitRelativePose(T_CURRENT_PREVIOUS[:3, :3], T_CURRENT_PREVIOUS[:3, 3] / LENGTH)


def scene(
    seed: int, noise_px: float = 0.3, outliers: int = 30
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """100 points ``(100, 3)``, their pixels ``(100, 2)``, and which of them are inliers."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(4.0, 25.0, 100)
    points = (
        np.column_stack([rng.uniform(-0.6, 0.6, 100), rng.uniform(-0.2, 0.2, 100), np.ones(100)])
        * depth[:, None]
    )
    seen = se3.apply(T_CAMERA_POINTS, points) @ K.T
    pixels = seen[:, :2] / seen[:, 2:] + noise_px * rng.normal(size=(100, 2))
    wrong = rng.permutation(100)[:outliers]
    pixels[wrong] += rng.choice([-1.0, 1.0], (outliers, 2)) * rng.uniform(20.0, 60.0, (outliers, 2))
    return points, pixels, ~np.isin(np.arange(100), wrong)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_camera_is_found_among_outliers_and_inliers_are_rows_of_the_points_given(seed: int):
    points, pixels, is_inlier = scene(5)
    T_start, inliers = consensus(points, pixels, K, 200, 2.0, seed)
    assert set(inliers) <= set(np.flatnonzero(is_inlier)) and len(inliers) > 60
    resection = resect([T_start], points[inliers], pixels[inliers], K)
    error = se3.invert(T_CAMERA_POINTS) @ resection.T_camera_world
    assert np.rad2deg(se3.rotation_angle(error[:3, :3])) < 0.1
    assert np.linalg.norm(error[:3, 3]) < 0.05


def test_pixels_without_a_common_camera_have_none():
    points, _, _ = scene(0)
    pixels = np.random.default_rng(1).uniform(0.0, 300.0, (100, 2))
    _, inliers = consensus(points, pixels, K, 200, 0.5)
    assert len(inliers) < 12


def test_sigmas_are_those_of_the_errors_of_refined_cameras():
    whitened = []
    for seed in range(60):
        points, pixels, _ = scene(seed, noise_px=0.5, outliers=0)
        T_start, inliers = consensus(points, pixels, K, 200, 3.0)
        resection = resect([T_start], points[inliers], pixels[inliers], K)
        error = resection.T_camera_world @ se3.invert(T_CAMERA_POINTS)
        shift = error[:3, 3]
        turned = (
            np.array(
                [error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]]
            )
            / 2
        )
        whitened.append(np.concatenate([turned, shift]) / resection.sigmas)
    rms = np.sqrt(np.square(whitened).mean(axis=0))
    assert (rms > 0.7).all() and (rms < 1.4).all(), rms


def test_an_order_is_a_permutation_by_its_seed():
    np.testing.assert_array_equal(ransac_order(50, 0), np.arange(50))
    one, same, other = ransac_order(50, 1), ransac_order(50, 1), ransac_order(50, 2)
    np.testing.assert_array_equal(one, same)
    assert (one != other).any() and (one != np.arange(50)).any()
    np.testing.assert_array_equal(np.sort(one), np.arange(50))
    assert len(ransac_order(0, 3)) == 0


def seen(count: int = 80) -> tuple[FloatArray, FloatArray]:
    points = np.random.default_rng(0).uniform((-2.0, -1.5, 3.0), (2.0, 1.5, 6.0), (count, 3))
    homogeneous = apply(T_TRUE, points) @ INTRINSICS.K.T
    return points, homogeneous[:, :2] / homogeneous[:, 2:]


def test_jacobian_is_the_derivative_of_the_pixels():
    X = apply(T_TRUE, seen(10)[0])
    focal = np.array([500.0, 400.0])
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        ahead, behind = (
            apply(from_rotation_vector(s * step[:3], s * step[3:]), X) for s in (1.0, -1.0)
        )
        numeric = (ahead[:, :2] / ahead[:, 2:] - behind[:, :2] / behind[:, 2:]) * focal / 2e-6
        np.testing.assert_allclose(pixel_jacobian(X, focal)[axis].T, numeric, atol=1e-4)


def test_finds_the_pose_from_a_far_guess():
    points, pixels = seen()
    pose = resect((np.eye(4),), points, pixels, INTRINSICS.K)
    np.testing.assert_allclose(pose.T_camera_world, T_TRUE, atol=1e-6)
    assert pose.residual_px.max() < 1e-3


def test_a_camera_that_moves_and_turns_steadily_stays_rigid():
    """Each pose begins at the one predicted by the last two, which fits."""
    rng = np.random.default_rng(1)
    T_step = from_rotation_vector(np.array([0.002, 0.02, 0.001]), np.array([0.01, 0.0, -0.03]))
    true = before = now = np.eye(4)
    for _ in range(300):
        true = T_step @ true
        points = rng.uniform((-2.0, -1.5, 3.0), (2.0, 1.5, 6.0), (40, 3))
        predicted = now @ invert(before) @ now
        found = resect(
            (predicted,), apply(invert(true), points), INTRINSICS.project(points), INTRINSICS.K
        )
        before, now = now, found.T_camera_world
    assert is_se3(now, tolerance=1e-12)
    assert rotation_angle(now[:3, :3] @ true[:3, :3].T) < 1e-6


def test_a_wrong_prediction_does_not_outweigh_the_last_pose():
    points, pixels = seen()
    pixels[:20] += 25.0
    wrong = from_rotation_vector(np.array([0.0, 0.8, 0.0]), np.array([1.0, 0.0, 0.0])) @ T_TRUE
    near = from_rotation_vector(np.array([0.0, 0.01, 0.0]), np.array([0.01, 0.0, 0.0])) @ T_TRUE
    pose = resect((near, wrong), points, pixels, INTRINSICS.K)
    np.testing.assert_allclose(pose.T_camera_world, T_TRUE, atol=1e-2)
    assert (pose.residual_px[20:] < 3.0).all()
    assert (pose.residual_px[:20] > 3.0).all()


def test_points_of_uncertain_depth_give_the_turn_and_only_the_direction_of_a_step():
    """All points at wrong depths: the pose is right, with what their parallax is off taken as their uncertainty."""
    points, pixels = seen(200)
    first = np.linalg.inv(T_TRUE)[:3, 3] + [0.2, 0.05, 0.0]
    factor = np.exp(np.random.default_rng(1).normal(0.0, 0.3, (200, 1)))
    wrong = first + factor * (points - first)
    exact = resect((T_TRUE,), wrong, pixels, INTRINSICS.K)
    known = resect((T_TRUE,), wrong, pixels, INTRINSICS.K, spread=0.3 * (wrong - first))

    def turned(T: FloatArray) -> float:
        return float(rotation_angle(T[:3, :3] @ T_TRUE[:3, :3].T))

    assert turned(known.T_camera_world) < 0.3 * turned(exact.T_camera_world)
    assert np.median(known.residual_px) < 0.5 * np.median(exact.residual_px)


@pytest.mark.parametrize("seed", range(3))
def test_in_front_of_a_wall_errors_are_no_step_of_a_camera_that_turns_where_it_stood(seed: int):
    rng = np.random.default_rng(seed)
    wall = rng.uniform((-1.2, -0.8, 1.9), (1.2, 0.8, 2.1), (100, 3))
    T_true = from_rotation_vector(np.array([0.01, 0.1, 0.0]), np.zeros(3))
    pixels = INTRINSICS.project(apply(T_true, wall)) + rng.normal(0.0, 1.0, (100, 2))
    errors = [
        T_true @ invert(resect((T_true,), wall, pixels, INTRINSICS.K, still=place).T_camera_world)
        for place in (None, np.zeros(3))
    ]
    free, still = (rotation_angle(T[:3, :3]) for T in errors)
    assert still < 0.5 * free


def test_the_majority_is_not_the_world_where_others_have_the_vote():
    points, pixels = seen(200)
    trusted = np.arange(200) < 50
    T_moved = from_rotation_vector(np.array([0.0, 0.05, 0.0]), np.array([0.1, 0.0, 0.0])) @ T_TRUE
    moved = apply(T_moved, points) @ INTRINSICS.K.T
    pixels[~trusted] = (moved[:, :2] / moved[:, 2:])[~trusted]
    pose = resect((T_TRUE, T_moved), points, pixels, INTRINSICS.K, trusted=trusted)
    np.testing.assert_allclose(pose.T_camera_world, T_TRUE, atol=1e-6)
    assert (pose.residual_px[~trusted] > 3.0).all()


def matched_rays(
    noise_px: float = 0.0, outliers: int = 0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rays ``(120, 3)`` in both cameras, the first ``outliers`` of them wrong, and the depths in the earlier one."""
    rng = np.random.default_rng(0)
    previous = np.column_stack(
        [rng.uniform(-0.8, 0.8, 120), rng.uniform(-0.25, 0.25, 120), np.ones(120)]
    )
    depth = rng.uniform(4.0, 30.0, 120)
    moved = se3.apply(T_CURRENT_PREVIOUS, previous * depth[:, None])
    current = moved / moved[:, 2:]
    current[:, :2] += noise_px / FOCAL_PX * rng.normal(size=(120, 2))
    current[:outliers, :2] += rng.uniform(0.1, 0.3, (outliers, 2))
    return previous, current, depth


def degrees_between(found: UnitRelativePose) -> tuple[float, float]:
    """Errors of rotation and direction."""
    cosine = float(np.clip(found.direction @ UNIT_POSE.direction, -1.0, 1.0))
    rotation = se3.rotation_angle(found.R_current_previous.T @ UNIT_POSE.R_current_previous)
    return float(np.rad2deg(rotation)), float(np.rad2deg(np.arccos(cosine)))


@pytest.mark.parametrize("seed", [0, 1, 7])
def test_both_consensus_methods_find_the_motion_among_outliers(seed: int):
    previous, current, depth = matched_rays(noise_px=0.1, outliers=30)
    depth[::9] = np.nan
    tolerance = 1.0 / FOCAL_PX
    for found in (
        unit_pose_by_essential(previous, current, tolerance, seed),
        unit_pose_by_pnp(previous, current, depth, 2.0 * tolerance, seed),
    ):
        assert found is not None
        rotation_deg, direction_deg = degrees_between(found)
        assert rotation_deg < 0.5 and direction_deg < 10.0  # of minimal samples, to be refined


def test_too_few_points_have_no_motion():
    previous, current, depth = matched_rays()
    assert (
        unit_pose_by_pnp(previous, current, np.where(np.arange(120) < 7, depth, np.nan), 1e-2)
        is None
    )


def test_depths_are_triangulated_in_both_cameras():
    previous, current, depth = matched_rays()
    found = triangulated_depth(previous, current, UNIT_POSE)
    np.testing.assert_allclose(found * LENGTH, depth, rtol=1e-9)
    in_current = se3.apply(T_CURRENT_PREVIOUS, previous * depth[:, None])[:, 2]
    np.testing.assert_allclose(
        depth_in_current(previous, found, UNIT_POSE) * LENGTH, in_current, rtol=1e-9
    )
    backwards = UnitRelativePose(UNIT_POSE.R_current_previous, -UNIT_POSE.direction)
    assert (triangulated_depth(previous, current, backwards) < 0).all()


def test_parallax_is_the_flow_without_that_of_the_rotation():
    previous, _, _ = matched_rays()
    rotated = previous @ UNIT_POSE.R_current_previous.T
    rotated /= rotated[:, 2:]
    assert (
        parallax_px(previous, rotated, UNIT_POSE.R_current_previous, (FOCAL_PX, FOCAL_PX)).max()
        < 1e-9
    )
    shifted = rotated + np.array([3.0, 4.0, 0.0]) / FOCAL_PX
    np.testing.assert_allclose(
        parallax_px(previous, shifted, UNIT_POSE.R_current_previous, (FOCAL_PX, FOCAL_PX)), 5.0
    )


def test_a_pure_rotation_is_found_with_a_fifth_of_outliers():
    previous, _, _ = matched_rays()
    rotated = previous @ UNIT_POSE.R_current_previous.T
    rotated /= rotated[:, 2:]
    rotated[:24, :2] += 0.05
    found = rotation_between(previous, rotated)
    assert np.rad2deg(se3.rotation_angle(found.T @ UNIT_POSE.R_current_previous)) < 1e-6
