"""Two-view geometry of drawn points with a known motion."""

from __future__ import annotations

import numpy as np
import pytest

from slam.geometry import se3
from slam.geometry.epipolar import (
    UnitRelativePose,
    depth_in_current,
    parallax_px,
    rotation_between,
    triangulated_depth,
    unit_pose_by_essential,
    unit_pose_by_pnp,
)
from slam.geometry.se3 import FloatArray

FOCAL_PX = 240.0
LENGTH = 0.8
T_CURRENT_PREVIOUS = se3.from_rotation_vector(np.deg2rad([0.3, -2.0, 0.2]), LENGTH * np.array([0.28, 0.0, -0.96]))
UNIT_POSE = UnitRelativePose(T_CURRENT_PREVIOUS[:3, :3], T_CURRENT_PREVIOUS[:3, 3] / LENGTH)


def matched_rays(noise_px: float = 0.0, outliers: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rays ``(120, 3)`` in both cameras, the first ``outliers`` of them wrong, and the depths in the earlier one."""
    rng = np.random.default_rng(0)
    previous = np.column_stack([rng.uniform(-0.8, 0.8, 120), rng.uniform(-0.25, 0.25, 120), np.ones(120)])
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
def test_both_consensus_methods_find_the_motion_among_outliers(seed: int) -> None:
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


def test_too_few_points_have_no_motion() -> None:
    previous, current, depth = matched_rays()
    assert unit_pose_by_pnp(previous, current, np.where(np.arange(120) < 7, depth, np.nan), 1e-2) is None


def test_depths_are_triangulated_in_both_cameras() -> None:
    previous, current, depth = matched_rays()
    found = triangulated_depth(previous, current, UNIT_POSE)
    np.testing.assert_allclose(found * LENGTH, depth, rtol=1e-9)
    in_current = se3.apply(T_CURRENT_PREVIOUS, previous * depth[:, None])[:, 2]
    np.testing.assert_allclose(depth_in_current(previous, found, UNIT_POSE) * LENGTH, in_current, rtol=1e-9)
    backwards = UnitRelativePose(UNIT_POSE.R_current_previous, -UNIT_POSE.direction)
    assert (triangulated_depth(previous, current, backwards) < 0).all()


def test_parallax_is_the_flow_without_that_of_the_rotation() -> None:
    previous, _, _ = matched_rays()
    rotated = previous @ UNIT_POSE.R_current_previous.T
    rotated /= rotated[:, 2:]
    assert parallax_px(previous, rotated, UNIT_POSE.R_current_previous, (FOCAL_PX, FOCAL_PX)).max() < 1e-9
    shifted = rotated + np.array([3.0, 4.0, 0.0]) / FOCAL_PX
    np.testing.assert_allclose(parallax_px(previous, shifted, UNIT_POSE.R_current_previous, (FOCAL_PX, FOCAL_PX)), 5.0)


def test_a_pure_rotation_is_found_with_a_fifth_of_outliers() -> None:
    previous, _, _ = matched_rays()
    rotated = previous @ UNIT_POSE.R_current_previous.T
    rotated /= rotated[:, 2:]
    rotated[:24, :2] += 0.05
    found = rotation_between(previous, rotated)
    assert np.rad2deg(se3.rotation_angle(found.T @ UNIT_POSE.R_current_previous)) < 1e-6
