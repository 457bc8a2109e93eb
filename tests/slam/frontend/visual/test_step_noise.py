"""Noise of steps by the rotation jitter of a drive and by the neighbours of a step."""

from __future__ import annotations

import numpy as np
import pytest

from slam.frontend.visual.step_noise import (
    JITTER_DIRECTION,
    JITTER_ROTATION,
    NEIGHBOUR_ROTATION,
    inflate_step_sigmas,
    neighbour_residual,
    rotation_jitter,
)
from slam.geometry.se3 import from_rotation_vector


def own(count: int, sigma_rad: float = 0.0) -> dict[int, np.ndarray]:
    return {k: np.full(6, sigma_rad) for k in range(count)}


def steps(turns_rad: np.ndarray) -> dict[int, np.ndarray]:
    return {k: from_rotation_vector(turn, np.array([0.0, 0.0, 1.0])) for k, turn in enumerate(turns_rad)}


def turns(jitter_rad: np.ndarray, count: int = 400) -> np.ndarray:
    """A slalom, which is smooth, with white noise of three sigmas."""
    smooth = np.stack([np.zeros(count), 0.03 * np.sin(np.arange(count) / 30.0), np.zeros(count)], axis=1)
    return smooth + np.random.default_rng(0).normal(size=(count, 3)) * jitter_rad


def rotations(jitter_rad: np.ndarray, count: int = 400) -> dict[int, np.ndarray]:
    return dict(enumerate(turns(jitter_rad, count)))


def test_jitter_is_the_residual_to_a_smooth_motion():
    jitter_rad = np.array([1e-3, 2e-4, 5e-4])
    np.testing.assert_allclose(rotation_jitter(rotations(jitter_rad)), jitter_rad, rtol=0.2)
    assert rotation_jitter(rotations(np.zeros(3))).max() < 1e-5


def test_gaps_are_left_out_and_few_steps_have_no_jitter():
    drive = rotations(np.full(3, 1e-3))
    np.testing.assert_allclose(rotation_jitter({k: r for k, r in drive.items() if k % 40 != 7}), 1e-3, rtol=0.3)
    np.testing.assert_array_equal(rotation_jitter({k: r for k, r in drive.items() if k % 4}), 0.0)
    np.testing.assert_array_equal(rotation_jitter({}), 0.0)


def test_the_neighbour_residual_is_large_at_a_jump_and_not_beside_it():
    even = {k: np.array([0.0, 0.01 * k, 0.0]) for k in range(9)}
    even[4] = even[4] + [0.05, 0.0, 0.0]
    sizes = np.array([neighbour_residual(even, k) for k in range(9)])
    np.testing.assert_allclose(sizes[4], [0.05, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(sizes[[0, 1, 7, 8], 1:], 0.0, atol=1e-12)
    assert sizes[[3, 5], 0].max() <= 0.025 + 1e-12
    np.testing.assert_array_equal(neighbour_residual({3: np.ones(3)}, 3), 0.0)


def test_sigmas_are_ratios_of_jitter():
    jittery = turns(np.full(3, 1e-3))
    noise, jitter = inflate_step_sigmas(steps(jittery), own(400)), rotation_jitter(dict(enumerate(jittery)))
    assert noise.keys() == set(range(400))
    smallest = min(noise.values(), key=lambda sigmas: sigmas[3:].sum())
    assert smallest[3] == pytest.approx(JITTER_DIRECTION * np.linalg.norm(jitter), rel=0.1)
    assert smallest[5] < 0.1 * smallest[3], "an error along the motion is one of length"
    for sigmas in noise.values():
        assert (sigmas[:3] >= JITTER_ROTATION * jitter).all()


def test_a_jump_widens_its_own_step():
    smooth = np.zeros((60, 3))
    smooth[:, 1] = np.deg2rad(5.0) * np.sin(np.arange(60) / 25.0) ** 2
    jumping = smooth.copy()
    jumping[30, 0] += np.deg2rad(1.0)
    before, after = (inflate_step_sigmas(steps(drive), own(60)) for drive in (smooth, jumping))
    assert after[30][0] == pytest.approx(NEIGHBOUR_ROTATION * np.deg2rad(1.0), rel=0.1)
    np.testing.assert_allclose(after[10][:3], before[10][:3], atol=1e-6)


def test_noise_explained_by_corners_is_not_counted_twice():
    jittery = steps(turns(np.full(3, 1e-3)))
    alone, known = (inflate_step_sigmas(jittery, own(400, sigma)) for sigma in (0.0, 1.5e-3))
    pitch = [sigmas[0] for sigmas in known.values()]
    assert np.median(pitch) < 0.03e-3, "white noise of the corners' own size is no jitter"
    assert all((known[k] <= alone[k]).all() for k in alone)
    assert inflate_step_sigmas({}, {}) == {}
    assert inflate_step_sigmas({4: jittery[4]}, own(5))[4].tolist() == [0.0] * 6, "a step without neighbours"
