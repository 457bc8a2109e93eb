"""Rotations of steps corrected by relative rotations across two of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.frames import Ends, RelativePose
from slam.frontend.rotations import smooth_rotations
from slam.frontend.visual.motion import Motion, RelativeRotation, Steps
from slam.geometry.se3 import FloatArray, invert, make

SIGMA = np.deg2rad(0.02)
ROTATIONS = 40
T_CURRENT_PREVIOUS = np.array([0.1, 0.0, -1.2])  # translation of every step


def small(rng: np.random.Generator, sigma: float) -> FloatArray:
    return Rotation.from_rotvec(rng.normal(0.0, sigma, 3)).as_matrix()


def true_rotations(rng: np.random.Generator) -> list[FloatArray]:
    """``R_current_previous`` of a drive that turns by up to 4 degrees a step."""
    return [
        Rotation.from_euler("y", 4.0 * np.sin(0.3 * k), degrees=True).as_matrix()
        @ small(rng, 0.005)
        for k in range(ROTATIONS)
    ]


def table_of(rotations: Mapping[Ends, FloatArray], correlation: float = 0.0) -> Steps:
    """Triangulated steps with these ``R_current_previous``; turning right by an angle moves them right by two."""
    sigmas = np.repeat([SIGMA, 0.01], 3)
    covariance = SIGMA**2 * np.diag([1.0, 1.0, 1.0, 4.0, 4.0, 4.0])
    covariance[1, 3] = covariance[3, 1] = 2.0 * correlation * SIGMA**2
    return {
        ends: Motion(
            RelativePose(*ends, invert(make(R, T_CURRENT_PREVIOUS)), sigmas, "essential"),
            covariance,
        )
        for ends, R in rotations.items()
    }


def single(rotations: list[FloatArray]) -> Steps:
    return table_of({(k, k + 1): R for k, R in enumerate(rotations)})


def rotations_of(table: Steps) -> dict[Ends, FloatArray]:
    return {
        motion.ends: invert(motion.relative_pose.T_from_to)[:3, :3] for motion in table.values()
    }


def error_deg(table: Steps, truth: list[FloatArray]) -> float:
    """Of the rotation of the whole drive."""
    R, R_true, rotations = np.eye(3), np.eye(3), rotations_of(table)
    for k in range(ROTATIONS):
        R, R_true = rotations[k, k + 1] @ R, truth[k] @ R_true
    return float(np.rad2deg(Rotation.from_matrix(R @ R_true.T).magnitude()))


def drive(
    bias: FloatArray, baseline_noise: float, seed: int = 0
) -> tuple[Steps, dict[tuple[int, ...], RelativeRotation], list[FloatArray]]:
    """Steps with a rotation error of ``bias`` each, and rotations across two steps with the same error."""
    rng = np.random.default_rng(seed)
    truth, off = true_rotations(rng), Rotation.from_rotvec(bias).as_matrix()
    sigmas = np.full(3, SIGMA)
    steps = single([off @ small(rng, 0.1 * SIGMA) @ R for R in truth])
    across = {
        (k, k + 1, k + 2): RelativeRotation(
            off @ small(rng, baseline_noise) @ truth[k + 1] @ truth[k], sigmas
        )
        for k in range(ROTATIONS - 1)
    }
    return steps, across, truth


@pytest.mark.parametrize("axis", range(3))
def test_a_bias_of_every_measurement_counts_half_as_often_over_two_steps(axis: int):
    steps, across, truth = drive(SIGMA * np.eye(3)[axis], 0.1 * SIGMA)
    assert error_deg(smooth_rotations(steps, across), truth) < 0.65 * error_deg(steps, truth)


def test_a_relative_rotation_that_is_far_off_is_an_outlier():
    steps, across, truth = drive(np.zeros(3), 0.1 * SIGMA)
    before = error_deg(smooth_rotations(steps, across), truth)
    wrong = Rotation.from_euler("y", 5.0, degrees=True).as_matrix() @ across[10, 11, 12].R_to_from
    across[10, 11, 12] = RelativeRotation(wrong, across[10, 11, 12].sigmas)
    assert error_deg(smooth_rotations(steps, across), truth) < before + 0.02


def test_steps_that_are_not_triangulated_stay_and_are_not_crossed():
    steps, across, _ = drive(np.array([SIGMA, 0.0, 0.0]), 0.1 * SIGMA)
    by_points = Motion(steps[20, 21].relative_pose)
    smoothed = smooth_rotations({**steps, (20, 21): by_points}, across)
    assert smoothed[20, 21] is by_points
    without = smooth_rotations({e: m for e, m in steps.items() if e != (20, 21)}, across)
    for ends, R in rotations_of(without).items():
        np.testing.assert_array_equal(R, rotations_of(smoothed)[ends])


def test_directions_follow_rotations_as_far_as_they_are_correlated():
    biased, across, _ = drive(np.array([0.0, SIGMA, 0.0]), 0.1 * SIGMA)
    for correlation in (0.0, 0.9):
        steps = table_of(rotations_of(biased), correlation)
        smoothed = smooth_rotations(steps, across)
        for before, after in zip(steps.values(), smoothed.values(), strict=True):
            R, R_before = (
                invert(motion.relative_pose.T_from_to)[:3, :3] for motion in (after, before)
            )
            turned = Rotation.from_matrix(R @ R_before.T).as_rotvec()[1]
            seen = invert(after.relative_pose.T_from_to)[:3, 3]
            assert np.abs(turned) > 0.1 * SIGMA
            assert np.linalg.norm(seen) == pytest.approx(np.linalg.norm(T_CURRENT_PREVIOUS))
            moved = (seen - T_CURRENT_PREVIOUS)[0] / np.linalg.norm(T_CURRENT_PREVIOUS)
            assert moved == pytest.approx(2.0 * correlation * turned, rel=0.02, abs=1e-12)
            np.testing.assert_array_equal(after.relative_pose.sigmas, before.relative_pose.sigmas)


def test_steps_that_skip_frames_are_smoothed_like_others():
    """The same drive, whose frames are numbered three apart: every step skips two frames."""
    steps, across, truth = drive(np.array([SIGMA, 0.0, 0.0]), 0.1 * SIGMA)
    expected = rotations_of(smooth_rotations(steps, across))
    sparse = table_of({(3 * k, 3 * k + 3): R for (k, _), R in rotations_of(steps).items()})
    sparse_across = {tuple(3 * k for k in frames): each for frames, each in across.items()}
    for (first, _), R in rotations_of(smooth_rotations(sparse, sparse_across)).items():
        np.testing.assert_allclose(R, expected[first // 3, first // 3 + 1], atol=1e-12)
    inside = RelativeRotation(truth[0], np.full(3, SIGMA))
    ends_inside = {(k, k + 2, k + 4): inside for k in range(0, 60, 3)}
    assert smooth_rotations(sparse, ends_inside) is sparse
