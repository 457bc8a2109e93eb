"""Noise of steps by the rotation jitter of a drive and by the neighbours of a step."""

from __future__ import annotations

import numpy as np
import pytest

from slam.frames import RelativePose
from slam.frontend.visual.motion import Motion
from slam.frontend.visual.noise import (
    JITTER_DIRECTION,
    JITTER_ROTATION,
    NEIGHBOUR_ROTATION,
    neighbour_residual,
    rotation_jitter,
    step_noise,
)
from slam.geometry.se3 import from_rotation_vector


def noise_of(turns_rad: np.ndarray, sigma_rad: float = 0.0, first: int = 0) -> np.ndarray:
    """Of a drive that goes straight on; corners tell each step to a sigma."""
    poses = [from_rotation_vector(turn, np.array([0.0, 0.0, 1.0])) for turn in turns_rad]
    ends = [(k, k + 1) for k in range(first, first + len(poses))]
    covariance = sigma_rad**2 * np.eye(6)
    motions = {
        step: Motion(RelativePose(*step, T, np.ones(6), "essential"), covariance)
        for step, T in zip(ends, poses, strict=True)
    }
    noise = step_noise(motions, first + len(poses) + 1)
    return np.array([noise[step] for step in ends])


def turns(jitter_rad: np.ndarray, count: int = 400) -> np.ndarray:
    """A slalom, which is smooth, with white noise of three sigmas."""
    smooth = np.stack(
        [np.zeros(count), 0.03 * np.sin(np.arange(count) / 30.0), np.zeros(count)], axis=1
    )
    return smooth + np.random.default_rng(0).normal(size=(count, 3)) * jitter_rad


def test_jitter_is_the_residual_to_a_smooth_motion():
    jitter_rad = np.array([1e-3, 2e-4, 5e-4])
    np.testing.assert_allclose(rotation_jitter(turns(jitter_rad)), jitter_rad, rtol=0.2)
    assert rotation_jitter(turns(np.zeros(3))).max() < 1e-5


def test_gaps_are_left_out_and_few_steps_have_no_jitter():
    drive, number = turns(np.full(3, 1e-3)), np.arange(400)[:, None]
    np.testing.assert_allclose(
        rotation_jitter(np.where(number % 40 != 7, drive, np.nan)), 1e-3, rtol=0.3
    )
    np.testing.assert_array_equal(rotation_jitter(np.where(number % 4, drive, np.nan)), 0.0)
    np.testing.assert_array_equal(rotation_jitter(drive[:2]), 0.0)


def test_the_neighbour_residual_is_large_at_a_jump_and_not_beside_it():
    even = np.outer(np.arange(9), [0.0, 0.01, 0.0])
    even[4] += [0.05, 0.0, 0.0]
    sizes = neighbour_residual(even)
    np.testing.assert_allclose(sizes[4], [0.05, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(sizes[[0, 1, 7, 8], 1:], 0.0, atol=1e-12)
    assert sizes[[3, 5], 0].max() <= 0.025 + 1e-12
    np.testing.assert_array_equal(neighbour_residual(np.ones((1, 3))), 0.0)


def test_sigmas_are_ratios_of_jitter():
    jittery = turns(np.full(3, 1e-3))
    noise, jitter = noise_of(jittery), rotation_jitter(jittery)
    smallest = min(noise, key=lambda sigmas: sigmas[3:].sum())
    assert smallest[3] == pytest.approx(JITTER_DIRECTION * np.linalg.norm(jitter), rel=0.1)
    assert smallest[5] < 0.1 * smallest[3], "an error along the motion is one of length"
    assert (noise[:, :3] >= JITTER_ROTATION * jitter).all()


def test_a_jump_widens_its_own_step():
    smooth = np.zeros((60, 3))
    smooth[:, 1] = np.deg2rad(5.0) * np.sin(np.arange(60) / 25.0) ** 2
    jumping = smooth.copy()
    jumping[30, 0] += np.deg2rad(1.0)
    before, after = (noise_of(drive) for drive in (smooth, jumping))
    assert after[30][0] == pytest.approx(NEIGHBOUR_ROTATION * np.deg2rad(1.0), rel=0.1)
    np.testing.assert_allclose(after[10][:3], before[10][:3], atol=1e-6)


def test_noise_explained_by_corners_is_not_counted_twice():
    jittery = turns(np.full(3, 1e-3))
    alone, known = (noise_of(jittery, sigma) for sigma in (0.0, 1.5e-3))
    assert np.median(known[:, 0]) < 0.03e-3, "white noise of the corners' own size is no jitter"
    assert (known <= alone).all()
    assert step_noise({}, 1) == {}
    assert noise_of(jittery[:1], first=4).tolist() == [[0.0] * 6], "a step without neighbours"
