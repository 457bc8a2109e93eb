"""Residuals across and along epipolar lines, and their derivatives by finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from slam.frontend.visual.residuals import Residuals, tangent_of
from slam.geometry import se3
from slam.geometry.epipolar import UnitRelativePose

FOCAL_PX = 240.0
LENGTH = 0.9


@pytest.fixture
def unit_pose() -> UnitRelativePose:
    R = se3.from_rotation_vector(np.array([0.01, 0.06, 0.02]), np.zeros(3))[:3, :3]
    return UnitRelativePose(R, np.array([0.1, -0.05, -1.0]) / np.linalg.norm([0.1, -0.05, -1.0]))


def rays(seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matched rays ``(20, 3)``, far off their lines, and learned depths ``(20,)`` of which one is unknown."""
    rng = np.random.default_rng(seed)
    previous = np.column_stack([rng.uniform(-1.0, 1.0, (20, 2)), np.ones(20)])
    current = previous + np.column_stack([rng.normal(0.0, 0.2, (20, 2)), np.zeros(20)])
    return previous, current, np.concatenate([[np.nan], rng.uniform(4.0, 30.0, 19)])


def moved(unit_pose: UnitRelativePose, step: np.ndarray, tangent: np.ndarray) -> UnitRelativePose:
    slid = unit_pose.direction + tangent @ step[3:5]
    turned = se3.from_rotation_vector(step[:3], np.zeros(3))[:3, :3]
    return UnitRelativePose(turned @ unit_pose.R_current_previous, slid / np.linalg.norm(slid))


def test_across_is_the_sampson_distance_of_the_essential_matrix(unit_pose: UnitRelativePose):
    previous, current, depth = rays()
    E = np.cross(np.eye(3), unit_pose.direction).T @ unit_pose.R_current_previous
    expected = []
    for x, y in zip(previous, current, strict=True):
        gradient = np.concatenate([(E @ x)[:2], (E.T @ y)[:2]])
        expected.append(FOCAL_PX * (y @ E @ x) / np.linalg.norm(gradient))
    across, _ = Residuals(previous, current, depth, FOCAL_PX).across(unit_pose, tangent_of(unit_pose.direction))
    np.testing.assert_allclose(np.abs(across), np.abs(expected), rtol=1e-9)
    assert len(set(np.sign(across) * np.sign(expected))) == 1


def test_along_is_the_distance_to_the_point_predicted_by_depth(unit_pose: UnitRelativePose):
    """Corners moved along their lines by what is then found; across them nothing counts."""
    previous, _, depth = rays()
    points = se3.apply(se3.make(unit_pose.R_current_previous, LENGTH * unit_pose.direction), previous * depth[:, None])
    seen = points / points[:, 2:]
    turned = previous @ unit_pose.R_current_previous.T
    line = (seen - turned / turned[:, 2:])[:, :2]
    line /= np.linalg.norm(line, axis=1)[:, None]
    aside = np.linspace(-0.02, 0.02, 20)
    current = seen.copy()
    current[:, :2] += aside[:, None] * line + 0.01 * line[:, ::-1] * [1.0, -1.0]
    tangent = tangent_of(unit_pose.direction)
    along, _, shift_px = Residuals(previous, current, depth, FOCAL_PX).along(unit_pose, LENGTH, tangent)
    np.testing.assert_allclose(along[1:], -FOCAL_PX * aside[1:], atol=1e-9)
    expected = FOCAL_PX * np.linalg.norm((seen - turned / turned[:, 2:])[:, :2], axis=1)
    np.testing.assert_allclose(shift_px[1:], expected[1:], rtol=1e-9)


def test_derivatives_across_are_those_of_finite_differences(unit_pose: UnitRelativePose):
    """With corners far off their lines, where the change of the gradient's norm counts."""
    residuals, tangent = Residuals(*rays(), FOCAL_PX), tangent_of(unit_pose.direction)
    _, slopes = residuals.across(unit_pose, tangent)
    for k in range(5):
        step = 1e-6 * np.eye(5)[k]
        ahead, behind = (residuals.across(moved(unit_pose, sign * step, tangent), tangent)[0] for sign in (1, -1))
        np.testing.assert_allclose((ahead - behind) / 2e-6, slopes[k], atol=1e-8 * FOCAL_PX)


def test_derivatives_along_are_those_of_finite_differences(unit_pose: UnitRelativePose):
    """Corners on their lines, where the rotation of the line has no effect; a corner of unknown depth is left out."""
    previous, _, depth = rays()
    points = se3.apply(se3.make(unit_pose.R_current_previous, LENGTH * unit_pose.direction), previous * depth[:, None])
    residuals, tangent = Residuals(previous, points / points[:, 2:], depth, FOCAL_PX), tangent_of(unit_pose.direction)
    _, slopes, _ = residuals.along(unit_pose, LENGTH, tangent)
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        ahead, behind = (
            residuals.along(moved(unit_pose, sign * step, tangent), LENGTH + sign * step[5], tangent)[0]
            for sign in (1, -1)
        )
        np.testing.assert_allclose(((ahead - behind) / 2e-6)[1:], slopes[k][1:], atol=1e-7 * FOCAL_PX)


@pytest.mark.parametrize(
    "direction", [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.6, 0, -0.8], [0.6, -0.8, 0]]
)
def test_a_tangent_and_its_direction_are_orthonormal(direction: list[float]):
    axes = np.column_stack([tangent_of(np.array(direction)), direction])
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
