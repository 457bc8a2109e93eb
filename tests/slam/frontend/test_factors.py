"""Factors in one unit from all measurements, and the odometry chained from them; steps may skip frames."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from oracle import snippets_of

from slam.frames import Ends, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.factors import chain_odometry, make_factors
from slam.frontend.gaps import INTERPOLATED_SOURCE
from slam.frontend.lidar_odometry import LIDAR_SOURCE
from slam.frontend.measured import Measured
from slam.frontend.network_motion import NETWORK_SOURCE, STUDENT_T_DOF, network_steps
from slam.frontend.scale import Scale, StepLength
from slam.frontend.visual.motion import Motion
from slam.geometry.se3 import FloatArray, chain, from_rotation_vector, invert
from slam.runtime.errors import Failed

FRAMES = 12
METRES = 4.0  # per unscaled length


def drive(step: float = 1.0) -> FloatArray:
    """A gentle curve with steps of some length."""
    turns = np.tile([0.0, 0.05, 0.0], (FRAMES - 1, 1))
    return chain(from_rotation_vector(turns, np.tile([0.0, 0.0, step], (FRAMES - 1, 1))))


TRUE = drive()


def pose(first: int, last: int, source: str = "essential", T: FloatArray = TRUE) -> RelativePose:
    return RelativePose(first, last, invert(T[first]) @ T[last], np.full(6, 0.01), source)


def motions(steps: list[Ends], T: FloatArray) -> dict[Ends, Motion]:
    return {ends: Motion(pose(*ends, T=T), 0.002**2 * np.eye(6)) for ends in steps}


def scale(lengths: Mapping[Ends, float] | None = None) -> Scale:
    known = {ends: StepLength(value, 0.02, 0.03) for ends, value in (lengths or {}).items()}
    per_frame, unit = np.full(FRAMES, METRES), "the networks' own unit"
    return Scale("camera-height", Failed("drawn"), per_frame, known, unit, {})


STEPS = [(0, 1), (1, 2), (2, 5), (5, 6), (6, 7), (8, 9)]


def test_every_measurement_becomes_a_factor_in_the_unit_of_the_scale():
    small = drive(1.0 / METRES)
    interpolated = [pose(7, 8, "interpolated", small)]
    drawn = Drive(
        Measured(),
        steps=motions(STEPS, small),
        network_steps=network_steps(snippets_of(small)),
        gap_steps=interpolated,
    )
    found = make_factors(drawn, scale())
    assert {factor.source for factor in found} == {"essential", "interpolated", NETWORK_SOURCE}
    for factor in found:
        np.testing.assert_allclose(
            factor.T_from_to, invert(TRUE[factor.from_index]) @ TRUE[factor.to_index], atol=1e-9
        )
    assert [factor.ends for factor in found if factor.source == "essential"] == STEPS
    sigmas = {factor.source: factor.sigmas for factor in found}
    np.testing.assert_allclose(sigmas["interpolated"][3:], METRES * 0.01)


def test_a_step_takes_its_own_length_also_where_it_skips_frames():
    """Learned depth makes every step three times too long; a step of one frame and one of three have own lengths."""
    wrong = drive(3.0 / METRES)
    lengths = {
        ends: float(np.linalg.norm(pose(*ends).T_from_to[:3, 3])) for ends in ((0, 1), (2, 5))
    }
    found = {
        f.ends: f for f in make_factors(Drive(Measured(), motions(STEPS, wrong)), scale(lengths))
    }
    for ends in lengths:
        np.testing.assert_allclose(found[ends].T_from_to, pose(*ends).T_from_to, atol=1e-9)
        assert found[ends].student_t_dof == STUDENT_T_DOF
        assert found[ends].correlated_sigmas is not None
        assert found[ends].sigmas[5] == pytest.approx(0.02 * lengths[ends], rel=0.05)
        assert found[ends].graph_sigmas[5] == pytest.approx(0.03 * lengths[ends], rel=0.05)
    np.testing.assert_allclose(
        found[1, 2].T_from_to[2, 3], 3.0 * pose(1, 2).T_from_to[2, 3], rtol=1e-9
    )
    assert found[1, 2].student_t_dof == np.inf


def test_the_network_has_a_factor_on_every_step_that_nothing_else_measures_where_its_unit_is_not_known() -> (
    None
):
    found = make_factors(
        Drive(Measured(), motions(STEPS, TRUE), network_steps=network_steps(snippets_of(TRUE))),
        scale(),
    )
    every = [(k, k + 1) for k in range(FRAMES - 1)]
    assert [f.ends for f in found if f.source == NETWORK_SOURCE] == [
        ends for ends in every if ends not in STEPS
    ]


def by_network() -> list[RelativePose]:
    """With the opposite rotation, so that its steps can be recognised."""
    return [
        RelativePose(k, k + 1, T_OF_NETWORK, np.full(6, 0.1), NETWORK_SOURCE)
        for k in range(FRAMES - 1)
    ]


T_OF_NETWORK = from_rotation_vector(np.array([0.0, -0.1, 0.0]), np.array([0.0, 0.0, 0.5 * METRES]))


def test_odometry_chains_steps_that_skip_frames():
    """Frames 3 and 4 lie inside of a step and are chained by the network; frame 5 is chained to frame 2."""
    T = chain_odometry([*(pose(*ends) for ends in STEPS), *by_network()], FRAMES)
    for k in (0, 1, 2, 5, 6, 7):
        np.testing.assert_allclose(T[k], TRUE[k], atol=1e-9)
    np.testing.assert_allclose(T[3], T[2] @ T_OF_NETWORK, atol=1e-9)
    np.testing.assert_allclose(T[4], T[3] @ T_OF_NETWORK, atol=1e-9)
    np.testing.assert_allclose(T[8], T[7] @ T_OF_NETWORK, atol=1e-9)
    np.testing.assert_allclose(T[9], T[8] @ pose(8, 9).T_from_to, atol=1e-9)
    np.testing.assert_allclose(T[11], T[9] @ T_OF_NETWORK @ T_OF_NETWORK, atol=1e-9)


def test_odometry_takes_the_step_from_the_nearest_frame_and_the_last_of_these():
    wrong = drive(3.0)
    mixed = [pose(0, 2, T=wrong), pose(1, 2, T=wrong), pose(1, 2), pose(0, 1), pose(0, 2, T=wrong)]
    np.testing.assert_allclose(chain_odometry(mixed, 3)[2], TRUE[2], atol=1e-9)


def test_odometry_takes_lidar_before_a_guess_and_images_before_lidar():
    wrong = drive(3.0)
    guess, scan = pose(0, 1, INTERPOLATED_SOURCE, wrong), pose(0, 1, LIDAR_SOURCE)
    np.testing.assert_allclose(chain_odometry([scan, guess], 2)[1], TRUE[1], atol=1e-9)
    scan = pose(0, 1, LIDAR_SOURCE, wrong)
    np.testing.assert_allclose(chain_odometry([pose(0, 1), scan], 2)[1], TRUE[1], atol=1e-9)
