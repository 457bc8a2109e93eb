"""A motion keeps its rotation and direction when its length is replaced, and its translation when the rotation is.

Noise of steps by the rotation jitter of a drive and by the neighbours of a step.
"""

from __future__ import annotations

import numpy as np
import pytest

from slam.frames import Ends, RelativePose
from slam.frontend.visual.motion import (
    AXIS_SIGMA,
    JITTER_DIRECTION,
    JITTER_ROTATION,
    NEIGHBOUR_ROTATION,
    Motion,
    MotionHistory,
    links,
    neighbour_residual,
    path_between,
    pose_sigmas,
    rotation_jitter,
    shortest_by_start,
    step_noise,
)
from slam.geometry import se3
from slam.geometry.multiview import UnitRelativePose
from slam.geometry.se3 import from_rotation_vector

NO_NOISE = np.zeros(6)
ROTATION_SIGMAS, DIRECTION_SIGMAS = np.full(3, 2e-4), np.array([0.004, 0.004, 0.0])
T_PREVIOUS_CURRENT = se3.from_rotation_vector(
    np.deg2rad([0.0, 1.0, 0.0]), np.array([0.1, 0.0, 2.0])
)


def triangulated_motion() -> Motion:
    sigmas = pose_sigmas(
        T_PREVIOUS_CURRENT, np.concatenate([ROTATION_SIGMAS, DIRECTION_SIGMAS]), 0.05
    )
    pose = RelativePose(4, 5, T_PREVIOUS_CURRENT, sigmas, "essential")
    return Motion(pose, np.diag(np.concatenate([ROTATION_SIGMAS, DIRECTION_SIGMAS]) ** 2))


def test_another_length_keeps_rotation_and_direction() -> None:
    motion = triangulated_motion()
    scaled = motion.with_length(1.0, 0.03, 0.09, NO_NOISE)
    np.testing.assert_array_equal(scaled.T_from_to[:3, :3], T_PREVIOUS_CURRENT[:3, :3])
    np.testing.assert_allclose(
        scaled.T_from_to[:3, 3], T_PREVIOUS_CURRENT[:3, 3] / np.hypot(0.1, 2.0), atol=1e-12
    )
    np.testing.assert_array_equal(scaled.sigmas[:3], motion.relative_pose.sigmas[:3])
    assert 0.0299 <= scaled.sigmas[5] < 0.035
    assert scaled.correlated_sigmas is not None
    np.testing.assert_array_equal(scaled.correlated_sigmas[:3], scaled.sigmas[:3])
    assert 0.0899 <= scaled.correlated_sigmas[5] < 0.095
    assert (scaled.ends, scaled.source) == ((4, 5), "essential")
    np.testing.assert_array_equal(motion.relative_pose.T_from_to, T_PREVIOUS_CURRENT)


def test_further_noise_adds_in_squares_to_that_of_the_corners() -> None:
    motion = triangulated_motion()
    own = motion.with_length(2.0, 0.03, 0.09, NO_NOISE).sigmas
    added = np.array([0.01, 0.02, 0.0, 0.05, 0.05, 0.0])
    noisier = motion.with_length(2.0, 0.03, 0.09, added).sigmas
    np.testing.assert_allclose(noisier[:3], np.hypot(own[:3], [0.01, 0.02, 0.0]))
    np.testing.assert_allclose(noisier[3:5], np.hypot(own[3:5], 2.0 * 0.05), rtol=0.01)
    assert noisier[5] == pytest.approx(own[5], rel=0.02)


def test_no_sigma_of_a_translation_is_zero() -> None:
    ahead = se3.from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, 2.0]))
    sigmas = pose_sigmas(ahead, np.concatenate([ROTATION_SIGMAS, [0.004, 0.0, 0.0]]), 0.05)
    np.testing.assert_allclose(sigmas, [*ROTATION_SIGMAS, 0.008, 0.002, 0.1])


@pytest.mark.parametrize(
    ("first", "last", "path"),
    [
        (0, 1, [(0, 1)]),
        (0, 6, [(0, 1), (1, 4), (4, 6)]),
        (1, 4, [(1, 4)]),
        (1, 6, [(1, 4), (4, 6)]),
        (4, 4, []),
        (0, 3, None),  # inside of a step
        (2, 4, None),  # no step begins there
        (1, 5, None),  # the last step leads further
        (4, 7, None),  # nothing leads on
    ],
)
def test_a_path_is_made_of_steps_that_follow_each_other(
    first: int, last: int, path: list[Ends] | None
) -> None:
    by_start = shortest_by_start([(0, 1), (1, 4), (4, 6), (0, 4)])
    assert path_between(by_start, first, last) == path


@pytest.mark.parametrize(
    ("steps", "frames", "found"),
    [
        ([], 4, [(0, 1), (1, 2), (2, 3)]),
        ([(k, k + 1) for k in range(3)], 4, [(0, 1), (1, 2), (2, 3)]),
        ([(0, 1), (1, 4), (5, 6)], 8, [(0, 1), (1, 4), (4, 5), (5, 6), (6, 7)]),
        ([(0, 3), (1, 2), (3, 6)], 7, [(0, 3), (3, 6)]),  # a step inside of another is no link
        ([(0, 2), (0, 1), (1, 3), (2, 3)], 4, [(0, 1), (1, 3)]),
        ([], 1, []),
    ],
)
def test_links_lead_from_the_first_frame_to_the_last(
    steps: list[Ends], frames: int, found: list[Ends]
) -> None:
    assert links(steps, frames) == found


def heading(aside_deg: float) -> UnitRelativePose:
    aside = np.deg2rad(aside_deg)
    return UnitRelativePose(np.eye(3), np.array([np.sin(aside), 0.0, -np.cos(aside)]))


def history_of(asides_deg: np.ndarray, speed: float = 6.0) -> MotionHistory:
    history = MotionHistory()
    for aside_deg in asides_deg:
        history = history.with_step(heading(aside_deg), 0.9, speed)
    return history


def test_few_steps_give_no_usual_direction() -> None:
    prior = history_of(np.zeros(9)).prior()
    assert prior.axis_sigma == np.inf
    np.testing.assert_array_equal(prior.axis, np.zeros(3))


def test_the_usual_direction_and_its_sigma_are_those_of_the_steps() -> None:
    asides = 3.0 + 15.0 * np.random.default_rng(0).normal(size=90)
    asides[::30] = 80.0  # slides
    prior = history_of(asides).prior()
    assert np.rad2deg(np.arctan2(prior.axis[0], -prior.axis[2])) == pytest.approx(3.0, abs=4.0)
    assert np.rad2deg(prior.axis_sigma) == pytest.approx(np.hypot(15.0, 8.0), rel=0.3)
    assert history_of(np.zeros(20)).prior().axis_sigma == pytest.approx(AXIS_SIGMA)


def test_only_the_last_steps_are_kept() -> None:
    history = history_of(np.concatenate([np.full(50, 30.0), np.zeros(100)]))
    assert len(history.directions) == 100
    np.testing.assert_allclose(history.directions[0], heading(0.0).direction)


def test_a_step_that_loses_a_third_of_its_inliers_is_noticed() -> None:
    history = history_of(np.zeros(20))
    assert history.is_sudden_loss(0.55) and not history.is_sudden_loss(0.65)
    assert not history_of(np.zeros(5)).is_sudden_loss(0.1)


def test_a_car_brakes_with_no_more_than_ten_metres_a_second_squared() -> None:
    history = history_of(np.zeros(20), speed=6.0)  # camera heights a second, 10 m/s
    assert history.is_possible_speed(5.0, 0.1) and history.is_possible_speed(7.0, 0.1)
    assert history.is_possible_speed(2.5, 0.1) is False
    assert history.is_possible_speed(2.5, 0.5)
    assert history_of(np.zeros(2)).is_possible_speed(2.5, 0.1) is None
    assert history_of(np.zeros(20), speed=np.nan).is_possible_speed(2.5, 0.1) is None


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
