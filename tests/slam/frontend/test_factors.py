"""Factors in one unit from all measurements, and the odometry chained from them; steps may skip frames.

The pose network's steps as factors in a measured unit with a measured noise, and as the raw trajectory.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import pytest
from oracle import snippets_of

from slam.frames import KEYFRAME_SOURCE, Ends, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.factors import (
    NETWORK_SOURCE,
    STUDENT_T_DOF,
    calibrate_network,
    chain_odometry,
    chain_raw,
    join_gap_ends,
    make_factors,
    network_factors,
    network_steps,
)
from slam.frontend.gaps import INTERPOLATED_SOURCE
from slam.frontend.scale import Scale, StepLength
from slam.frontend.visual.motion import Motion
from slam.geometry import se3
from slam.geometry.se3 import FloatArray, chain, from_rotation_vector, invert
from slam.graph.pose_graph import PoseGraph
from slam.results.estimate_metrics import coverage
from slam.runtime.errors import Failed

FRAMES = 12
METRES = 4.0  # per unscaled length
COUNT = 300
UNIT = 0.75  # of learned depth per unit of the network
UNIT_METRES = 1.6  # per unit of learned depth
ROTATION, TRANSLATION = (
    np.deg2rad(0.1),
    0.08,
)  # sigmas of a step of the network, the latter over its length
DEPTH_UNIT = np.full(COUNT, UNIT_METRES)


def drive(step: float = 1.0) -> FloatArray:
    """A gentle curve with steps of some length."""
    turns = np.tile([0.0, 0.05, 0.0], (FRAMES - 1, 1))
    return chain(from_rotation_vector(turns, np.tile([0.0, 0.0, step], (FRAMES - 1, 1))))


TRUE = drive()


def pose(first: int, last: int, source: str = "essential", T: FloatArray = TRUE) -> RelativePose:
    return RelativePose(first, last, invert(T[first]) @ T[last], np.full(6, 0.01), source)


def motions(steps: list[Ends], T: FloatArray) -> list[Motion]:
    return [Motion(pose(*ends, T=T), 0.002**2 * np.eye(6)) for ends in steps]


def scale(lengths: Mapping[Ends, float] | None = None) -> Scale:
    known = {ends: StepLength(value, 0.02, 0.03) for ends, value in (lengths or {}).items()}
    return Scale(
        "camera-height", Failed("drawn"), np.full(FRAMES, METRES), known, "the networks' own unit"
    )


def factors(
    measured: Drive, scale: Scale, lidar: tuple[RelativePose, ...] = ()
) -> list[RelativePose]:
    return make_factors(measured, scale, lidar)


STEPS = [(0, 1), (1, 2), (2, 5), (5, 6), (6, 7), (8, 9)]


def test_every_measurement_becomes_a_factor_in_the_unit_of_the_scale() -> None:
    small = drive(1.0 / METRES)
    interpolated = [pose(7, 8, "interpolated", small)]
    lidar = (pose(3, 4, "lidar"),)  # in metres already
    found = factors(
        Drive(motions=motions(STEPS, small), trusted=snippets_of(small), gap_steps=interpolated),
        scale(),
        lidar,
    )
    assert {factor.source for factor in found} == {
        "essential",
        "interpolated",
        "lidar",
        NETWORK_SOURCE,
    }
    for factor in found:
        np.testing.assert_allclose(
            factor.T_from_to, invert(TRUE[factor.from_index]) @ TRUE[factor.to_index], atol=1e-9
        )
    assert [factor.ends for factor in found if factor.source == "essential"] == STEPS
    sigmas = {factor.source: factor.sigmas for factor in found}
    np.testing.assert_allclose(sigmas["interpolated"][3:], METRES * 0.01)
    np.testing.assert_allclose(sigmas["lidar"], 0.01)


def test_a_step_takes_its_own_length_also_where_it_skips_frames() -> None:
    """Learned depth makes every step three times too long; a step of one frame and one of three have own lengths."""
    wrong = drive(3.0 / METRES)
    lengths = {
        ends: float(np.linalg.norm(pose(*ends).T_from_to[:3, 3])) for ends in ((0, 1), (2, 5))
    }
    found = {f.ends: f for f in factors(Drive(motions=motions(STEPS, wrong)), scale(lengths))}
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
    found = factors(Drive(motions=motions(STEPS, TRUE), trusted=snippets_of(TRUE)), scale())
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


def test_odometry_chains_steps_that_skip_frames() -> None:
    """Frames 3 and 4 lie inside of a step and are chained by the network; frame 5 is chained to frame 2."""
    T = chain_odometry([*(pose(*ends) for ends in STEPS), *by_network()], FRAMES)
    for k in (0, 1, 2, 5, 6, 7):
        np.testing.assert_allclose(T[k], TRUE[k], atol=1e-9)
    np.testing.assert_allclose(T[3], T[2] @ T_OF_NETWORK, atol=1e-9)
    np.testing.assert_allclose(T[4], T[3] @ T_OF_NETWORK, atol=1e-9)
    np.testing.assert_allclose(T[8], T[7] @ T_OF_NETWORK, atol=1e-9)
    np.testing.assert_allclose(T[9], T[8] @ pose(8, 9).T_from_to, atol=1e-9)
    np.testing.assert_allclose(T[11], T[9] @ T_OF_NETWORK @ T_OF_NETWORK, atol=1e-9)


def test_odometry_takes_the_step_from_the_nearest_frame_and_the_last_of_these() -> None:
    wrong = drive(3.0)
    mixed = [pose(0, 2, T=wrong), pose(1, 2, T=wrong), pose(1, 2), pose(0, 1), pose(0, 2, T=wrong)]
    np.testing.assert_allclose(chain_odometry(mixed, 3)[2], TRUE[2], atol=1e-9)


def network_drive(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    turns = np.stack(
        [0.01 * rng.normal(size=count), 0.1 * rng.normal(size=count), 0 * np.arange(count)], axis=1
    )
    steps = np.stack(
        [0 * np.arange(count), 0 * np.arange(count), 1 + 0.2 * rng.normal(size=count)], axis=1
    )
    return se3.chain(se3.from_rotation_vector(turns[1:], steps[1:]))


@pytest.mark.parametrize(("count", "sources"), [(5, 4), (6, 4), (30, 4), (3, 2), (20, 2)])
def test_exact_snippets_chain_to_the_truth(count, sources):
    T = network_drive(count)
    chained = chain_raw(snippets_of(T, sources), count)
    np.testing.assert_allclose(chained, T, atol=1e-9)
    np.testing.assert_array_equal(chained[0], np.eye(4))


def test_chain_uses_target_to_next_and_nothing_else():
    T = network_drive(12)
    snippets = snippets_of(T)
    for each in snippets:
        each.T_source_target[np.array(each.sources) != each.target + 1, 0, 3] += 0.5
    chained = chain_raw(snippets, 12)
    inner = se3.invert(chained[2:-2]) @ chained[3:-1]
    np.testing.assert_allclose(inner, se3.invert(T[2:-2]) @ T[3:-1], atol=1e-9)
    # the ends come from the direct poses, which are wrong here
    first, last = snippets[0], snippets[-1]
    np.testing.assert_allclose(
        se3.invert(chained[0]) @ chained[2], first.T_source_target[0], atol=1e-9
    )
    np.testing.assert_allclose(
        se3.invert(chained[1]) @ chained[2], first.T_source_target[1], atol=1e-9
    )
    np.testing.assert_allclose(
        se3.invert(chained[11]) @ chained[9], last.T_source_target[3], atol=1e-9
    )
    np.testing.assert_allclose(
        se3.invert(chained[10]) @ chained[9], last.T_source_target[2], atol=1e-9
    )


def test_a_step_that_several_snippets_see_is_their_mean():
    T, rng = network_drive(200), np.random.default_rng(3)
    snippets = snippets_of(T)
    for snippet in snippets:
        snippet.T_source_target[:, :3, 3] += 0.1 * rng.normal(size=(4, 3))
    raw, steps, true = chain_raw(snippets, 200), network_steps(snippets), se3.invert(T[:-1]) @ T[1:]
    assert list(steps) == list(range(199))
    single, mean = (
        np.square(found[:, :3, 3] - true[:, :3, 3]).mean()
        for found in (se3.invert(raw[:-1]) @ raw[1:], np.array(list(steps.values())))
    )
    assert mean < 0.6 * single


def seen_by_network(
    T: FloatArray, unit: FloatArray | float = UNIT, seed: int = 0
) -> dict[int, FloatArray]:
    """Steps in a unit ``(N - 1,)`` of their own, with noise in proportion to the usual length."""
    rng, count = np.random.default_rng(seed), len(T) - 1
    steps = se3.invert(T[:-1]) @ T[1:]
    noise = rng.normal(size=(count, 6)) * np.repeat([ROTATION, TRANSLATION], 3)
    steps = steps @ se3.from_rotation_vector(noise[:, :3], noise[:, 3:])
    steps[:, :3, 3] /= np.broadcast_to(UNIT_METRES * unit, count)[:, None]
    return dict(enumerate(steps))


def measured(T: FloatArray, frames: range = range(COUNT - 1), reach: int = 1) -> list[RelativePose]:
    """By image geometry in metres, with lengths to 2 %."""
    rng = np.random.default_rng(1)
    found = []
    for k in frames[: len(frames) + 1 - reach : reach]:
        T_from_to = se3.invert(T[k]) @ T[k + reach]
        T_from_to[:3, 3] *= 1 + 0.02 * rng.normal()
        sigmas = np.r_[np.full(3, 2e-4), np.full(3, 0.02 * np.linalg.norm(T_from_to[:3, 3]))]
        found.append(RelativePose(k, k + reach, T_from_to, sigmas, "essential"))
    return found


@pytest.mark.parametrize("reach", [1, 2])
def test_unit_and_noise_of_the_network_are_measured_on_the_drive(reach: int) -> None:
    T = network_drive(COUNT)
    found = calibrate_network(seen_by_network(T), measured(T, reach=reach), DEPTH_UNIT)
    assert np.median(found.unit) == pytest.approx(UNIT_METRES * UNIT, rel=0.01)
    np.testing.assert_allclose(found.unit, UNIT_METRES * UNIT, rtol=0.08)
    rotation, translation = (np.median(found.sigmas[:, part]) for part in (slice(3), slice(3, 6)))
    # the errors here are independent: over two steps they are smaller in proportion
    assert rotation == pytest.approx(ROTATION / np.sqrt(reach), rel=0.15)
    assert translation == pytest.approx(TRANSLATION / np.sqrt(reach), rel=0.15)


def test_the_unit_follows_the_drive() -> None:
    T, unit = network_drive(COUNT), UNIT * np.exp(0.3 * np.sin(np.linspace(0, 4, COUNT - 1)))
    found = calibrate_network(seen_by_network(T, unit), measured(T), DEPTH_UNIT)
    np.testing.assert_allclose(found.unit[20:-20], UNIT_METRES * unit[20:-19], rtol=0.1)


def test_a_third_of_wrong_steps_does_not_change_the_unit() -> None:
    T = network_drive(COUNT)
    geometric = [pose.scaled(3.0) if pose.from_index % 3 == 0 else pose for pose in measured(T)]
    found = calibrate_network(seen_by_network(T), geometric, DEPTH_UNIT)
    assert np.median(found.unit) == pytest.approx(UNIT_METRES * UNIT, rel=0.06)


def test_with_few_measured_steps_lengths_are_those_of_learned_depth_and_uncertain() -> None:
    T = network_drive(COUNT)
    steps = seen_by_network(T)
    for geometric in (
        [],
        measured(T, range(100, 119)),
        measured(np.tile(np.eye(4), (COUNT, 1, 1))),
    ):
        found = calibrate_network(steps, geometric, DEPTH_UNIT)
        np.testing.assert_array_equal(found.unit, DEPTH_UNIT)
        factor = network_factors(steps, found)[50]
        assert factor.T_from_to[2, 3] == pytest.approx(UNIT_METRES * steps[50][2, 3])
        assert abs(UNIT - 1) * factor.T_from_to[2, 3] < 1.5 * factor.sigmas[5]


def test_a_gap_of_image_geometry_is_bridged_with_its_true_length() -> None:
    T = network_drive(COUNT)
    gaps = [range(k, k + 20) for k in range(30, 260, 45)]
    geometric = [pose for pose in measured(T) if not any(pose.from_index in gap for gap in gaps)]
    steps = seen_by_network(T)
    factors = network_factors(steps, calibrate_network(steps, geometric, DEPTH_UNIT))
    errors = []
    for gap in gaps:
        T_first_last = se3.chain(np.array([factors[k].T_from_to for k in gap]))[-1]
        true = se3.invert(T[gap[0]]) @ T[gap[-1] + 1]
        errors.append(np.linalg.norm(T_first_last[:3, 3]) / np.linalg.norm(true[:3, 3]) - 1)
    assert np.abs(errors).max() < 0.1 and abs(np.mean(errors)) < 0.03


def test_stated_noise_of_the_network_holds() -> None:
    T, inside = network_drive(COUNT), []
    for seed in range(3):
        steps = seen_by_network(T, seed=seed)
        factors = network_factors(steps, calibrate_network(steps, measured(T), DEPTH_UNIT))
        inside.append(coverage(factors, T, 1.0)[""])
    for level, least, most in (("50", 0.4, 0.65), ("90", 0.85, 0.97), ("95", 0.91, 0.99)):
        assert least < np.mean([each[level] for each in inside]) < most


def test_the_network_makes_no_drive_shorter() -> None:
    T = network_drive(COUNT)
    geometric, steps = measured(T), seen_by_network(T)
    factors = network_factors(steps, calibrate_network(steps, geometric, DEPTH_UNIT))

    def length(*factors: RelativePose) -> float:
        graph = PoseGraph()
        graph.add_relative(*factors)
        return float(se3.path_distance(graph.optimise(T))[-1])

    assert length(*factors, *geometric) == pytest.approx(length(*geometric), rel=1e-3)


def test_errors_that_last_count_less_in_the_graph() -> None:
    T = network_drive(COUNT)
    steps = seen_by_network(T)
    for factor in network_factors(steps, calibrate_network(steps, measured(T), DEPTH_UNIT)):
        assert (factor.graph_sigmas > 4 * factor.sigmas).all()


def test_standing_still_keeps_positive_sigmas() -> None:
    steps = network_steps(snippets_of(np.tile(np.eye(4), (8, 1, 1))))
    for factor in network_factors(steps, calibrate_network(steps, [], np.ones(8))):
        assert (factor.sigmas > 0).all()


def relative(
    T_world_camera: FloatArray, first: int, last: int, sigma: float, source: str
) -> RelativePose:
    T = invert(T_world_camera[first]) @ T_world_camera[last]
    return RelativePose(first, last, T, np.full(6, sigma), source)


def test_a_long_gap_ends_where_the_map_says() -> None:
    """The camera was carried 2 m aside during 30 blank frames; constant velocity knows nothing of that."""
    count, before, after = 60, 20, 51
    centres = np.column_stack([0.01 * np.arange(count), np.zeros(count), np.zeros(count)])
    centres[before:] += [0.0, 2.0, 1.0]
    truth = from_rotation_vector(np.outer(np.arange(count) >= before, [0.3, 0.8, 0.1]), centres)
    step = from_rotation_vector(np.zeros(3), np.array([0.01, 0.0, 0.0]))
    mapped = [*range(before), *range(after + 1, count)]
    by_map = [relative(truth, a, b, 0.01, KEYFRAME_SOURCE) for a, b in pairwise(mapped)]
    guesses = [
        RelativePose(k, k + 1, step, np.full(6, 0.005), INTERPOLATED_SOURCE)
        for k in range(before - 1, after)
    ]
    measured = [relative(truth, after, after + 1, 0.01, "essential")]
    found = join_gap_ends(guesses, measured, by_map, dict.fromkeys(mapped, 0))
    assert [pose.ends for pose in found] == [pose.ends for pose in guesses]
    graph = PoseGraph()
    graph.add_relative(*found, *measured, *by_map)
    start = np.tile(np.eye(4), (count, 1, 1))
    for pose in [*found, *measured, *by_map]:
        start[pose.to_index] = start[pose.from_index] @ pose.T_from_to
    np.testing.assert_allclose(graph.optimise(start)[mapped], truth[mapped], atol=1e-6)


def test_a_gap_between_two_maps_stays_a_guess() -> None:
    guess = RelativePose(1, 2, np.eye(4), np.ones(6), INTERPOLATED_SOURCE)
    truth = from_rotation_vector(np.zeros((4, 3)), np.arange(12.0).reshape(4, 3))
    by_map = [
        relative(truth, 0, 1, 0.01, KEYFRAME_SOURCE),
        relative(truth, 2, 3, 0.01, KEYFRAME_SOURCE),
    ]
    (found,) = join_gap_ends([guess], [], by_map, {0: 0, 1: 0, 2: 1, 3: 1})
    assert found is guess
