"""A motion keeps its rotation and direction when its length is replaced; paths and links of steps."""

from __future__ import annotations

import numpy as np
import pytest

from slam.frames import Ends, RelativePose
from slam.frontend.visual.motion import Motion, links, pose_sigmas
from slam.geometry import se3

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


def test_another_length_keeps_rotation_and_direction():
    motion = triangulated_motion()
    scaled = motion.with_length(1.0, 0.03, 0.09, NO_NOISE)
    np.testing.assert_array_equal(scaled.T_from_to[:3, :3], T_PREVIOUS_CURRENT[:3, :3])
    np.testing.assert_allclose(
        scaled.T_from_to[:3, 3], T_PREVIOUS_CURRENT[:3, 3] / np.hypot(0.1, 2.0), atol=1e-12
    )
    np.testing.assert_array_equal(scaled.sigmas[:3], motion.relative_pose.sigmas[:3])
    assert 0.0299 <= scaled.sigmas[5] < 0.035
    np.testing.assert_array_equal(scaled.correlated_sigmas[:3], scaled.sigmas[:3])
    assert 0.0899 <= scaled.correlated_sigmas[5] < 0.095
    assert (scaled.ends, scaled.source) == ((4, 5), "essential")
    np.testing.assert_array_equal(motion.relative_pose.T_from_to, T_PREVIOUS_CURRENT)


def test_further_noise_adds_in_squares_to_that_of_the_corners():
    motion = triangulated_motion()
    own = motion.with_length(2.0, 0.03, 0.09, NO_NOISE).sigmas
    added = np.array([0.01, 0.02, 0.0, 0.05, 0.05, 0.0])
    noisier = motion.with_length(2.0, 0.03, 0.09, added).sigmas
    np.testing.assert_allclose(noisier[:3], np.hypot(own[:3], [0.01, 0.02, 0.0]))
    np.testing.assert_allclose(noisier[3:5], np.hypot(own[3:5], 2.0 * 0.05), rtol=0.01)
    assert noisier[5] == pytest.approx(own[5], rel=0.02)


def test_no_sigma_of_a_translation_is_zero():
    ahead = se3.from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, 2.0]))
    sigmas = pose_sigmas(ahead, np.concatenate([ROTATION_SIGMAS, [0.004, 0.0, 0.0]]), 0.05)
    np.testing.assert_allclose(sigmas, [*ROTATION_SIGMAS, 0.008, 0.002, 0.1])


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
):
    assert links(steps, frames) == found
