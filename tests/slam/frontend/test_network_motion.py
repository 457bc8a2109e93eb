"""The pose network's steps as factors in a measured unit with a measured noise, and as the raw trajectory."""

from __future__ import annotations

import numpy as np
import pytest
from oracle import snippets_of

from slam.frames import RelativePose
from slam.frontend.network_motion import (
    calibrate_network,
    chain_raw,
    network_factors,
    network_steps,
)
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.graph.pose_graph import PoseGraph
from slam.results.estimate_metrics import coverage

COUNT = 300
UNIT = 0.75  # of learned depth per unit of the network
UNIT_METRES = 1.6  # per unit of learned depth
ROTATION, TRANSLATION = (
    np.deg2rad(0.1),
    0.08,
)  # sigmas of a step of the network, the latter over its length
DEPTH_UNIT = np.full(COUNT, UNIT_METRES)


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
    for snippet, target, sources in ((first, 2, {0: 0, 1: 1}), (last, 9, {2: 10, 3: 11})):
        for row, source in sources.items():
            T_source_target = se3.invert(chained[source]) @ chained[target]
            np.testing.assert_allclose(T_source_target, snippet.T_source_target[row], atol=1e-9)


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
def test_unit_and_noise_of_the_network_are_measured_on_the_drive(reach: int):
    T = network_drive(COUNT)
    found = calibrate_network(seen_by_network(T), measured(T, reach=reach), DEPTH_UNIT)
    np.testing.assert_allclose(found.unit, UNIT_METRES * UNIT, rtol=0.02)
    rotation, translation = (np.median(found.sigmas[part]) for part in (slice(3), slice(3, 6)))
    # the errors here are independent: over two steps they are smaller in proportion
    assert rotation == pytest.approx(ROTATION / np.sqrt(reach), rel=0.15)
    assert translation == pytest.approx(TRANSLATION / np.sqrt(reach), rel=0.15)


def test_a_unit_that_drifts_is_noise_of_the_length():
    T, unit = network_drive(COUNT), UNIT * np.exp(0.3 * np.sin(np.linspace(0, 6, COUNT - 1)))
    steady = calibrate_network(seen_by_network(T), measured(T), DEPTH_UNIT)
    drifting = calibrate_network(seen_by_network(T, unit), measured(T), DEPTH_UNIT)
    np.testing.assert_allclose(drifting.unit, UNIT_METRES * UNIT, rtol=0.1)
    assert drifting.sigmas[5] > 2.0 * steady.sigmas[5]
    np.testing.assert_allclose(drifting.sigmas[:3], steady.sigmas[:3], rtol=0.05)


def test_a_third_of_wrong_steps_does_not_change_the_unit():
    T = network_drive(COUNT)
    geometric = [pose.scaled(3.0) if pose.from_index % 3 == 0 else pose for pose in measured(T)]
    found = calibrate_network(seen_by_network(T), geometric, DEPTH_UNIT)
    assert np.median(found.unit) == pytest.approx(UNIT_METRES * UNIT, rel=0.06)


def test_with_few_measured_steps_lengths_are_those_of_learned_depth_and_uncertain():
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


def test_a_gap_of_image_geometry_is_bridged_with_its_true_length():
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


def test_stated_noise_of_the_network_holds():
    T, inside = network_drive(COUNT), []
    for seed in range(3):
        steps = seen_by_network(T, seed=seed)
        factors = network_factors(steps, calibrate_network(steps, measured(T), DEPTH_UNIT))
        inside.append(coverage(factors, T, 1.0)[""])
    for level, least, most in (("50", 0.4, 0.65), ("90", 0.85, 0.97), ("95", 0.91, 0.99)):
        assert least < np.mean([each[level] for each in inside]) < most


def test_the_network_makes_no_drive_shorter():
    T = network_drive(COUNT)
    geometric, steps = measured(T), seen_by_network(T)
    factors = network_factors(steps, calibrate_network(steps, geometric, DEPTH_UNIT))

    def length(*factors: RelativePose) -> float:
        graph = PoseGraph()
        graph.add_relative(*factors)
        return float(se3.path_distance(graph.optimise(T))[-1])

    assert length(*factors, *geometric) == pytest.approx(length(*geometric), rel=1e-3)
