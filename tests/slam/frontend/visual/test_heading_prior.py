"""A direction of motion predicted from the rotation, fused with measured ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.frontend.visual.epipolar import UnitRelativePose
from slam.frontend.visual.heading_prior import HeadingPrior

LEAST = np.deg2rad(0.35)
STEPS = 150
# sigmas of yaw and of the lateral direction, and the correlation of their errors
YAW, ASIDE, CORRELATION = np.deg2rad(0.05), np.deg2rad(1.5), -0.8


def covariance() -> np.ndarray:
    C = np.diag(np.square([1e-4, YAW, 1e-4, ASIDE, 1e-4, 1e-6]))
    C[1, 3] = C[3, 1] = CORRELATION * YAW * ASIDE
    return C


def after_straight_steps(steps: int, covariance: np.ndarray) -> HeadingPrior:
    """The prior after so many steps straight ahead."""
    prior = HeadingPrior(LEAST)
    for _ in range(steps):
        prior = prior.with_step(UnitRelativePose(rotation_of(0.0), heading(0.0)), covariance)
    return prior


def yaw_errors(seed: int, slope: float, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors of yaw ``(STEPS,)`` before and after fusion on a drive.

    The lateral direction is ``slope`` times the yaw, with a standard deviation ``spread``, radians.
    """
    rng = np.random.default_rng(seed)
    prior = HeadingPrior(LEAST)
    before, after = np.zeros(STEPS), np.zeros(STEPS)
    for k in range(STEPS):
        yaw = np.deg2rad(4.0) * np.sin(k / 12.0)
        aside = slope * yaw + spread * rng.normal()
        errors = rng.multivariate_normal([0.0, 0.0], covariance()[np.ix_([1, 3], [1, 3])])
        measured = UnitRelativePose(rotation_of(yaw + errors[0]), heading(aside + errors[1]))
        fused, remaining = prior.fuse(measured, covariance())
        prior = prior.with_step(measured, covariance())
        before[k] = errors[0]
        after[k] = Rotation.from_matrix(fused.R_current_previous).as_rotvec()[1] - yaw
        assert np.linalg.norm(fused.direction) == pytest.approx(1.0)
        assert (np.linalg.eigvalsh(remaining) > -1e-15).all()
        assert remaining[1, 1] <= covariance()[1, 1] * (1 + 1e-9)
    return before, after


def rotation_of(yaw: float) -> np.ndarray:
    return Rotation.from_rotvec([0.0, yaw, 0.0]).as_matrix()


def heading(aside: float) -> np.ndarray:
    return np.array([np.sin(aside), 0.0, -np.cos(aside)])


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


def test_on_a_vehicle_the_prior_makes_yaw_more_accurate() -> None:
    """An exact direction would leave ``sqrt(1 - 0.8 ** 2)`` of the error of yaw; it varies by 0.3 degrees."""
    for seed in range(3):
        before, after = yaw_errors(seed, slope=-0.5, spread=np.deg2rad(0.3))
        assert rms(after[50:]) < 0.75 * rms(before[50:])


def test_on_a_freely_moving_camera_the_prior_has_no_effect() -> None:
    for seed in range(3):
        before, after = yaw_errors(seed, slope=0.0, spread=0.3)
        assert rms(after[50:]) == pytest.approx(rms(before[50:]), rel=0.03)


def test_the_first_steps_are_as_measured() -> None:
    before, after = yaw_errors(0, slope=-0.5, spread=0.0)
    np.testing.assert_allclose(after[:20], before[:20], atol=1e-12)
    assert (np.abs(after[20:] - before[20:]) > 1e-9).all()


def test_on_a_reversing_vehicle_the_prior_has_no_effect() -> None:
    backwards = UnitRelativePose(rotation_of(0.01), -heading(0.02))
    fused, remaining = after_straight_steps(40, covariance()).fuse(backwards, covariance())
    np.testing.assert_array_equal(fused.direction, backwards.direction)
    np.testing.assert_array_equal(remaining, covariance())


def test_a_well_measured_lateral_motion_outweighs_the_prior() -> None:
    """A direction 20 degrees off with small sigmas is not pulled to the usual one."""
    small = covariance() / 25.0
    slide = UnitRelativePose(rotation_of(0.0), heading(np.deg2rad(20.0)))
    fused, _ = after_straight_steps(40, small).fuse(slide, small)
    assert np.rad2deg(np.arcsin(fused.direction[0])) > 19.0


def test_a_prior_changes_only_by_an_added_step() -> None:
    prior = after_straight_steps(40, covariance())
    slide = UnitRelativePose(rotation_of(0.0), heading(np.deg2rad(1.0)))
    first, _ = prior.fuse(slide, covariance())
    taught = prior
    for _ in range(40):
        prior.fuse(slide, covariance())
        taught = taught.with_step(slide, covariance())
    np.testing.assert_array_equal(prior.fuse(slide, covariance())[0].direction, first.direction)
    assert taught.fuse(slide, covariance())[0].direction[0] > first.direction[0] + 1e-3


def test_only_the_last_steps_are_kept() -> None:
    assert len(after_straight_steps(250, covariance()).rotations) == 200
