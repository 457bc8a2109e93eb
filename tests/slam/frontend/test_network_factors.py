"""The pose network's snippets as factors with their noise, and as the raw trajectory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from erfsfm.pose_noise import PoseNoise
from slam.frames import RelativePose, SnippetPoses
from slam.frontend.network_factors import (
    UncalibratedNoise,
    calibrated_factors,
    chain_raw,
    measured_noise,
    network_factors,
    without_measured,
)
from slam.geometry import se3
from slam.runtime.errors import SlamError

USUAL = UncalibratedNoise()


def drive(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    turns = np.stack([0.01 * rng.normal(size=count), 0.1 * rng.normal(size=count), 0 * np.arange(count)], axis=1)
    steps = np.stack([0 * np.arange(count), 0 * np.arange(count), 1 + 0.2 * rng.normal(size=count)], axis=1)
    return se3.chain(se3.from_rotation_vector(turns[1:], steps[1:]))


def snippets_of(T, sources: int = 4, wrong: float = 0.0) -> list[SnippetPoses]:
    """One per target; every pose but target -> next is shifted by ``wrong``."""
    half, snippets = sources // 2, []
    for target in range(half, len(T) - half):
        indices = tuple(k for k in range(target - half, target + half + 1) if k != target)
        poses = np.stack([se3.invert(T[k]) @ T[target] for k in indices])
        for k, pose in zip(indices, poses, strict=True):
            pose[0, 3] += wrong * (k != target + 1)
        snippets.append(SnippetPoses(target, indices, poses))
    return snippets


@pytest.mark.parametrize(("count", "sources"), [(5, 4), (6, 4), (30, 4), (3, 2), (20, 2)])
def test_exact_snippets_chain_to_the_truth(count, sources):
    T = drive(count)
    chained = chain_raw(snippets_of(T, sources), count)
    np.testing.assert_allclose(chained, T, atol=1e-9)
    np.testing.assert_array_equal(chained[0], np.eye(4))


def test_chain_uses_target_to_next_and_nothing_else():
    T = drive(12)
    chained = chain_raw(snippets_of(T, wrong=0.5), 12)
    inner = se3.invert(chained[2:-2]) @ chained[3:-1]
    np.testing.assert_allclose(inner, se3.invert(T[2:-2]) @ T[3:-1], atol=1e-9)
    # the ends come from the direct poses, which are wrong here
    first, last = snippets_of(T, wrong=0.5)[0], snippets_of(T, wrong=0.5)[-1]
    np.testing.assert_allclose(se3.invert(chained[0]) @ chained[2], first.T_source_target[0], atol=1e-9)
    np.testing.assert_allclose(se3.invert(chained[1]) @ chained[2], first.T_source_target[1], atol=1e-9)
    np.testing.assert_allclose(se3.invert(chained[11]) @ chained[9], last.T_source_target[3], atol=1e-9)
    np.testing.assert_allclose(se3.invert(chained[10]) @ chained[9], last.T_source_target[2], atol=1e-9)


def test_sequences_that_snippets_do_not_cover_are_refused():
    snippets = snippets_of(drive(12))
    with pytest.raises(SlamError, match="4 frames is shorter than one snippet"):
        chain_raw([], 4)
    with pytest.raises(SlamError, match="without gaps"):
        chain_raw(snippets[:2] + snippets[3:], 12)
    with pytest.raises(SlamError, match="frame 0"):
        chain_raw(snippets[1:], 12)
    for count in (11, 13):
        with pytest.raises(SlamError, match=f"frame {count - 1}"):
            chain_raw(snippets, count)


def test_every_direct_pose_is_a_factor_in_its_own_direction():
    T = drive(10)
    factors = network_factors(snippets_of(T), USUAL)
    assert len(factors) == 4 * 6
    for factor in factors:
        expected = se3.invert(T[factor.from_index]) @ T[factor.to_index]
        np.testing.assert_allclose(factor.T_from_to, expected, atol=1e-12)
        assert 2 <= factor.to_index <= 7  # the target


def test_noise_follows_distance_length_and_repetition():
    T = np.tile(np.eye(4), (10, 1, 1))
    T[:, 2, 3] = 2.0 * np.arange(10)
    sigmas = {(f.from_index, f.to_index): f.sigmas for f in network_factors(snippets_of(T), USUAL)}
    once, twice = np.deg2rad(0.3), np.deg2rad(0.3) * np.sqrt(2)
    # pair (0, 2) is measured once, pair (4, 5) by two snippets
    np.testing.assert_allclose(sigmas[0, 2][:3], once * np.sqrt(2))
    np.testing.assert_allclose(sigmas[4, 5][:3], twice)
    np.testing.assert_allclose(sigmas[4, 5][3:], np.sqrt(2) * (0.1 * 2.0 + 0.05 * 2.0))
    np.testing.assert_allclose(sigmas[4, 6][3:], np.sqrt(2) * (0.1 * 4.0 + 0.05 * 2.0))
    np.testing.assert_array_equal(sigmas[5, 4], sigmas[4, 5])


def test_standing_still_keeps_positive_sigmas():
    for factor in network_factors(snippets_of(np.tile(np.eye(4), (8, 1, 1))), USUAL):
        assert (factor.sigmas > 0).all()


def geometry_of(T) -> list[RelativePose]:
    steps = zip(range(len(T) - 1), se3.invert(T[:-1]) @ T[1:])
    return [RelativePose(k, k + 1, T_k_next, np.full(6, 1e-3), "essential") for k, T_k_next in steps]


def test_noise_is_estimated_where_geometry_measured_the_same_steps():
    T, sigma_deg = drive(300), 2.0
    rng = np.random.default_rng(1)
    snippets = snippets_of(T)
    for snippet in snippets:
        for pose in snippet.T_source_target:
            turn = np.deg2rad(sigma_deg) * rng.normal(size=3)
            pose[:] = pose @ se3.from_rotation_vector(turn, np.zeros(3))
    measured = measured_noise(snippets, geometry_of(T))
    assert measured.rotation_sigma_deg == pytest.approx(sigma_deg, rel=0.15)
    assert measured.translation_relative_sigma == USUAL.translation_relative_sigma


def test_noise_stays_as_usual_where_the_network_is_better_or_geometry_measured_little():
    T = drive(60)
    assert measured_noise(snippets_of(T), geometry_of(T)) == USUAL
    assert measured_noise(snippets_of(T, wrong=5.0), geometry_of(T)[:3]) == USUAL


def test_network_factors_are_used_where_geometry_did_not_measure():
    T = drive(20)
    factors, geometric = network_factors(snippets_of(T), USUAL), geometry_of(T)
    assert without_measured(factors, geometric) == []
    assert without_measured(factors, []) == factors
    gap = without_measured(factors, geometric[:9] + geometric[10:])
    assert pairs_of(gap) == {(9, 10), (8, 10), (9, 11)}


def test_a_step_that_skips_frames_replaces_the_network_between_its_frames_alone():
    """Geometry measured from frame 9 to 11 at once, and not the single steps between them."""
    T = drive(20)
    factors, geometric = network_factors(snippets_of(T), USUAL), geometry_of(T)
    over_two = RelativePose(9, 11, se3.invert(T[9]) @ T[11], np.ones(6), "essential")
    gap = without_measured(factors, [*geometric[:9], over_two, *geometric[11:]])
    assert pairs_of(gap) == {(9, 10), (8, 10), (10, 11), (10, 12)}
    beside = without_measured(factors, [*geometric[:9], over_two, *geometric[10:]])
    assert pairs_of(beside) == {(9, 10), (8, 10)}
    alone = without_measured(factors, [over_two])
    assert len(factors) - len(alone) == 2 and (9, 11) not in pairs_of(alone)


def pairs_of(factors) -> set[tuple[int, int]]:
    return {tuple(sorted(factor.ends)) for factor in factors}


NOISE = PoseNoise(
    frame=(0.01,) * 6,
    turn=(0.0,) * 6,
    length=(0.0,) * 6,
    disagreement=(0.0,) * 6,
    correlation=(0.5,) * 6,
    pose_sha256="",
    measured_on=["simulated/600"],
    pairs=990,
)


def test_calibrated_noise_gives_each_pair_one_factor_with_any_overlap():
    T = drive(10)
    factors = {(f.from_index, f.to_index): f for f in calibrated_factors(snippets_of(T), [], NOISE)}
    # targets 2 to 7: pairs of neighbours from (1, 2) to (7, 8), pairs over two from (0, 2) to (7, 9)
    assert factors.keys() == {(k, k + 1) for k in range(1, 8)} | {(k, k + 2) for k in range(8)}
    for (first, last), factor in factors.items():
        np.testing.assert_allclose(factor.T_from_to, se3.invert(T[first]) @ T[last], atol=1e-9)
    np.testing.assert_allclose(factors[1, 2].sigmas, 0.01)  # measured by the snippet of 2 alone
    np.testing.assert_allclose(factors[4, 5].sigmas, 0.01 * np.sqrt(0.75))
    np.testing.assert_allclose(factors[4, 6].sigmas, 0.02 * np.sqrt(0.75))


def wobbling(T: np.ndarray, sigma: np.ndarray) -> list[SnippetPoses]:
    """Snippets with pitch errors of ``sigma`` by target ``(N,)``, radians, two independent ones for every pair."""
    rng, snippets = np.random.default_rng(1), snippets_of(T)
    for snippet in snippets:
        for pose in snippet.T_source_target:
            wrong = np.array([sigma[snippet.target], 0.0, 0.0]) * rng.normal()
            pose[:] = pose @ se3.from_rotation_vector(wrong, np.zeros(3))
    return snippets


def sigmas_of(factors: list[RelativePose]) -> dict[tuple[int, int], np.ndarray]:
    return {(f.from_index, f.to_index): f.sigmas for f in factors}


def exact_geometry(T: np.ndarray) -> list[RelativePose]:
    return [replace(g, sigmas=np.full(6, 1e-6)) for g in geometry_of(T)]


def test_a_drive_scales_calibrated_noise_up_and_down():
    T = drive(300)
    snippets, promised = wobbling(T, np.full(300, 0.05)), 0.01 * np.sqrt(0.75)
    scaled = sigmas_of(calibrated_factors(snippets, exact_geometry(T), NOISE))
    assert scaled[50, 51][0] == pytest.approx(0.05 / np.sqrt(2), rel=0.25)
    assert scaled[50, 51][1] == pytest.approx(0.3 * promised, rel=1e-3)  # the lower limit, however well both agree
    few = calibrated_factors(snippets, exact_geometry(T)[:9], NOISE)
    np.testing.assert_allclose(sigmas_of(few)[50, 51], promised, rtol=1e-3)
    assert {f.student_t_dof for f in few} == {np.inf}  # as calibrated


def test_noise_that_a_short_drive_cannot_check_is_for_gaps_alone():
    T = drive(21)
    steps = exact_geometry(T)
    assert calibrated_factors(snippets_of(T)[:15], steps, NOISE) == []
    gap = calibrated_factors(snippets_of(T), steps[:8] + steps[9:], NOISE)
    assert pairs_of(gap) == {(8, 9), (7, 9), (8, 10)}


def test_steps_that_skip_frames_scale_the_noise_of_pairs_as_far_apart():
    """Geometry leads over two frames at a time: pairs of neighbours keep the noise beside the weights."""
    T = drive(300)
    snippets = wobbling(T, np.full(300, 0.05))
    over_two = [
        RelativePose(k, k + 2, se3.invert(T[k]) @ T[k + 2], np.full(6, 1e-6), "essential") for k in range(0, 298, 2)
    ]
    scaled = sigmas_of(calibrated_factors(snippets, over_two, NOISE))
    promised = 0.01 * np.sqrt(0.75)
    np.testing.assert_allclose(scaled[50, 51], promised, rtol=1e-3)
    single = sigmas_of(calibrated_factors(snippets, exact_geometry(T), NOISE))
    for pair in ((50, 52), (51, 53)):  # steps begin at even frames, the scaling is that of the distance
        assert scaled[pair][0] == pytest.approx(single[pair][0], rel=0.25)
        assert scaled[pair][0] > 2 * promised


def test_turns_are_scaled_apart_from_straights():
    """A drive that turns from the middle on, where errors of the network are ten times as large."""
    turns = np.where(np.arange(299) < 150, 0.0, 0.03) + 1e-4 * np.sin(np.arange(299))
    steps = se3.from_rotation_vector(np.column_stack([0 * turns, turns, 0 * turns]), np.tile([0.0, 0.0, 1.0], (299, 1)))
    T = se3.chain(steps)
    snippets = wobbling(T, np.where(np.arange(300) < 150, 0.01, 0.1))
    scaled = sigmas_of(calibrated_factors(snippets, exact_geometry(T), NOISE))
    straight, turning = ([scaled[k, k + 1][0] for k in r] for r in (range(20, 130), range(170, 280)))
    assert np.median(turning) > 5 * np.median(straight)


def test_noise_of_geometry_is_added_to_that_of_the_network():
    T = drive(100)
    geometric = [replace(g, sigmas=np.full(6, 0.4)) for g in geometry_of(T)]
    factors = sigmas_of(calibrated_factors(snippets_of(T), geometric, NOISE))
    np.testing.assert_allclose(factors[50, 51], 0.4, rtol=1e-2)
    np.testing.assert_allclose(factors[50, 52], 0.4 * np.sqrt(2), rtol=1e-2)
    without_one = sigmas_of(calibrated_factors(snippets_of(T), geometric[:50] + geometric[51:], NOISE))
    np.testing.assert_allclose(without_one[50, 51], 0.4, rtol=1e-2)


def test_equal_turn_rates_have_one_scaling():
    T = se3.chain(se3.from_rotation_vector(np.zeros((99, 3)), np.tile([0.0, 0.0, 1.0], (99, 1))))
    factors = sigmas_of(calibrated_factors(wobbling(T, np.zeros(100)), exact_geometry(T), NOISE))
    np.testing.assert_allclose(factors[50, 51], 0.3 * 0.01 * np.sqrt(0.75), rtol=1e-3)


def test_correlated_errors_get_larger_sigmas_in_the_graph():
    """Errors of pitch are independent, those of roll are a bias of about the same size."""
    rng, count = np.random.default_rng(2), 400
    ahead = np.tile([0.0, 0.0, 1.0], (count - 1, 1))
    T, wrong = se3.chain(se3.from_rotation_vector(0 * ahead, ahead)), 0.01 * rng.normal(size=(count - 1, 3))
    wrong[:, 1], wrong[:, 2] = 0.0, 0.01 + 0.1 * wrong[:, 2]
    seen = snippets_of(se3.chain(se3.from_rotation_vector(wrong, ahead)))
    factors = calibrated_factors(seen, exact_geometry(T), NOISE)
    longer = {
        distance: np.median(
            [f.graph_sigmas / f.sigmas for f in factors if f.to_index - f.from_index == distance], axis=0
        )
        for distance in (1, 2)
    }
    # pairs of both distances measure the same twice; a hundred equal errors add up to ten times independent ones
    assert longer[1][0] == pytest.approx(np.sqrt(2), rel=0.3)
    assert longer[2][0] == pytest.approx(np.sqrt(2) * np.sqrt(2), rel=0.3)  # neighbours share a step
    assert longer[1][2] > 6 * np.sqrt(2) and longer[2][2] > 6 * np.sqrt(2)
    few = calibrated_factors(seen, exact_geometry(T)[:30], NOISE)
    for distance, pairs in ((1, 397), (2, 398)):  # too few to tell: taken to last for a quarter of the drive
        ratios = [f.graph_sigmas / f.sigmas for f in few if f.to_index - f.from_index == distance]
        np.testing.assert_allclose(ratios, np.sqrt(pairs // 4) * np.sqrt(2))
