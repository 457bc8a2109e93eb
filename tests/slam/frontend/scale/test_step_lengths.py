"""Lengths of all steps of a drive from ratios, road and learned depth."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from slam.frames import Ends, RelativePose
from slam.frontend.scale.step_lengths import StepEvidence, gather_evidence, marginals, solve_lengths
from slam.frontend.visual.motion import Motion
from slam.geometry.se3 import from_rotation_vector

STEPS = 200
RATIO_WIDENING, CORRELATED_WIDENING = 1.5, 1.5  # of the sigmas of ratios, and of those in the pose graph
TRUE = 1.0 + 0.3 * np.sin(np.arange(STEPS) / 15.0)


EVIDENCE = [field.name for field in fields(StepEvidence)]


def evidence(**measured: np.ndarray) -> StepEvidence:
    empty = {name: np.full(STEPS, np.nan) for name in EVIDENCE}
    return StepEvidence(**(empty | measured))


def ratios(noise: float = 0.0, seed: int = 0) -> dict[str, np.ndarray]:
    values = np.full(STEPS, np.nan)
    values[1:] = np.diff(np.log(TRUE)) + noise * np.random.default_rng(seed).normal(size=STEPS - 1)
    return {"ratio": values, "ratio_sigma": np.where(np.isfinite(values), 0.001, np.nan)}


def chained(noise: float, seed: int) -> dict[str, np.ndarray]:
    """Ratios with the sigma of their noise, which is widened later."""
    return ratios(noise, seed) | {"ratio_sigma": np.full(STEPS, noise / RATIO_WIDENING)}


def noisy(sigma: float, seed: int = 1) -> np.ndarray:
    return np.log(TRUE) + sigma * np.random.default_rng(seed).normal(size=STEPS)


def test_triangulation_propagates_rare_road_lengths_through_the_drive():
    """Where the road is seen in one step of forty and learned depth is twice too long, lengths are still right."""
    road = np.where(np.arange(STEPS) % 40 == 20, np.log(TRUE), np.nan)
    measured = evidence(
        absolute=road, absolute_sigma=np.full(STEPS, 0.06), learned=noisy(0.05) + np.log(2.0), **ratios(0.003)
    )
    solved = solve_lengths(measured)
    np.testing.assert_allclose(solved.length, TRUE, rtol=0.05)
    np.testing.assert_allclose(solved.unit_correction, 0.5, rtol=0.1)


def test_a_noisy_road_is_better_with_triangulation_than_without():
    absolute = {"absolute": noisy(0.05), "absolute_sigma": np.full(STEPS, 0.06)}
    alone = solve_lengths(evidence(**absolute)).length
    together = solve_lengths(evidence(**absolute, **ratios(0.003))).length
    errors = [np.sqrt(np.mean(np.log(lengths / TRUE) ** 2)) for lengths in (alone, together)]
    assert errors[0] > 0.03
    assert errors[1] < 0.4 * errors[0]


def test_a_quarter_of_wrong_roads_does_not_matter():
    road = noisy(0.03)
    road[::4] += np.log(1.6)
    measured = evidence(absolute=road, absolute_sigma=np.full(STEPS, 0.06), **ratios(0.003))
    np.testing.assert_allclose(solve_lengths(measured).length, TRUE, rtol=0.05)


def test_learned_depth_bridges_a_gap_in_the_unit_measured_around_it():
    """Steps 80 to 119 have neither road nor ratio, and learned lengths are 30 % short all along."""
    gap = (np.arange(STEPS) >= 80) & (np.arange(STEPS) < 120)
    tied = ratios()
    tied["ratio"] = np.where(gap | np.roll(gap, 1), np.nan, tied["ratio"])
    road = np.where(gap, np.nan, np.log(TRUE))
    learned = np.log(0.7 * TRUE)
    solved = solve_lengths(evidence(absolute=road, absolute_sigma=np.full(STEPS, 0.06), learned=learned, **tied))
    np.testing.assert_allclose(solved.length, TRUE, rtol=0.05)
    learned_only = solve_lengths(evidence(learned=learned))
    np.testing.assert_allclose(learned_only.length, 0.7 * TRUE, rtol=1e-6)
    np.testing.assert_allclose(learned_only.unit_correction, 1.0, atol=1e-6)


def test_steps_that_nothing_measured_have_no_length():
    learned = np.where(np.arange(STEPS) < 50, np.nan, np.log(TRUE))
    solved = solve_lengths(evidence(learned=learned))
    assert np.isnan(solved.length[:50]).all() and np.isfinite(solved.length[50:]).all()
    np.testing.assert_array_equal(np.isnan(solved.relative_sigma), np.isnan(solved.length))
    nothing = solve_lengths(StepEvidence.empty(5))
    assert np.isnan(nothing.length).all()
    np.testing.assert_array_equal(nothing.unit_correction, 1.0)


def motion(ends: Ends, metres: float, unit: float, ratio: float, seconds: float = np.nan) -> Motion:
    """A step, whose ratio to the one before is measured."""
    T = from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, unit * metres]))
    return Motion(RelativePose(*ends, T, np.full(6, 0.01), "essential"), np.eye(6), (np.log(ratio), 0.01), seconds)


def test_evidence_has_a_row_a_link_also_where_steps_skip_frames() -> None:
    """Frames a metre apart, a step over three frames between steps of one, and learned depth that drifts."""
    links = [(0, 1), (1, 2), (2, 5), (5, 6), (6, 7), (7, 8)]
    ratio = {(2, 5): 3.0, (5, 6): 1.0 / 3.0}
    motions = {
        ends: motion(ends, float(ends[1] - ends[0]), 0.1, ratio.get(ends, 1.0)) for ends in links if ends != (6, 7)
    }
    absolute = {(2, 5): (3.1, 0.05), (5, 6): (1.2, 0.06), (6, 7): (9.0, 0.06), (3, 4): (1.0, 0.06)}
    unit = np.linspace(10.0, 20.0, 9)
    evidence = gather_evidence(links, motions, absolute, unit)
    nan = np.nan
    expected = np.log([nan, 1.0, 3.0, 1.0 / 3.0, nan, nan])
    np.testing.assert_allclose(evidence.ratio, expected, atol=1e-9)
    np.testing.assert_array_equal(evidence.ratio_sigma, [nan, 0.01, 0.01, 0.01, nan, nan])
    lengths = np.array([1.0, 1.0, 3.0, 1.0, nan, 1.0])
    np.testing.assert_allclose(evidence.learned, np.log(0.1 * lengths * unit[[0, 1, 2, 5, 6, 7]]))
    np.testing.assert_allclose(evidence.absolute, np.log([nan, nan, 3.1, 1.2, nan, nan]))
    np.testing.assert_allclose(evidence.absolute_sigma, [nan, nan, 0.05, 0.06, nan, nan])


def test_sigmas_are_those_of_the_whole_system() -> None:
    """The chains of Schur complements give the same as inverting the whole matrix."""
    rng = np.random.default_rng(0)
    steps = 7
    pairs = [(2 * k, 2 * k + 1) for k in range(steps)]
    pairs += [(k, k + 2) for k in range(2 * steps - 2)]
    ties = np.zeros((len(pairs), 2 * steps))
    for row, pair in zip(ties, pairs):
        row[list(pair)] = rng.normal(size=2)
    A = np.concatenate([np.eye(2 * steps), ties])
    information = A.T @ A
    left = np.linalg.inv(information)[::2, ::2]
    expected = np.sqrt(np.diag(left))
    correlations = np.clip(np.diag(left, 1) / (expected[1:] * expected[:-1]), 0.0, 1.0)
    band = np.array([np.pad(np.diag(information, apart), (apart, 0)) for apart in (2, 1, 0)])
    sigmas, with_neighbours = marginals(band)
    np.testing.assert_allclose(sigmas, expected, rtol=1e-9)
    both_sides = 0.5 * (np.append(correlations[0], correlations) + np.append(correlations, correlations[-1]))
    np.testing.assert_allclose(with_neighbours, both_sides, atol=1e-9)


def test_correlated_sigmas_are_those_of_sums_of_lengths(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over 40 steps, independent errors of ``relative_correlated_sigma`` add up as the errors of the lengths do."""
    monkeypatch.setattr("slam.frontend.scale.step_lengths.OUTLIER_SIGMAS", 1e9)
    middle = slice(80, 120)
    alone, together = [], []
    for seed in range(60):
        absolute = {"absolute": noisy(0.06, seed=300 + seed), "absolute_sigma": np.full(STEPS, 0.06)}
        solved = solve_lengths(evidence(**absolute, **chained(0.02, seed)))
        summed = np.log(solved.length / TRUE)[middle].sum()
        alone.append(summed / np.linalg.norm(solved.relative_sigma[middle]))
        together.append(CORRELATED_WIDENING * summed / np.linalg.norm(solved.relative_correlated_sigma[middle]))
    assert 0.75 < np.sqrt(np.square(together).mean()) < 1.3
    assert np.sqrt(np.square(alone).mean()) > 1.5


def test_sigmas_are_those_of_the_errors_of_lengths(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in the middle of a gap of the road, where there are only triangulation and learned depth."""
    monkeypatch.setattr("slam.frontend.scale.step_lengths.OUTLIER_SIGMAS", 1e9)
    errors, sigmas = [], []
    for seed in range(20):
        road = noisy(0.06, seed=100 + seed)
        road[60:100] = np.nan
        absolute = {"absolute": road, "absolute_sigma": np.full(STEPS, 0.06)}
        learned = noisy(0.1, seed=200 + seed)
        solved = solve_lengths(evidence(**absolute, learned=learned, **chained(0.01, seed)))
        errors.append(np.log(solved.length / TRUE))
        sigmas.append(solved.relative_sigma)
    ratio = np.abs(errors) / np.array(sigmas)
    assert 0.75 < np.sqrt((ratio**2).mean()) < 1.25
    assert 0.75 < np.sqrt((ratio[:, 70:90] ** 2).mean()) < 1.25
    assert np.mean(sigmas, axis=0)[80] > 1.5 * np.mean(sigmas, axis=0)[30]


def driven(metres: np.ndarray) -> StepEvidence:
    """Steps of a tenth of a second, their lengths by learned depth alone."""
    links = [(k, k + 1) for k in range(len(metres))]
    motions = {ends: motion(ends, metres[ends[0]], 0.1, 1.0, seconds=0.1) for ends in links}
    motions = {ends: replace(step, length_ratio=None) for ends, step in motions.items()}
    return gather_evidence(links, motions, {}, np.full(len(metres) + 1, 10.0), camera_height=1.65)


def test_a_step_of_half_a_metre_between_metres_is_an_outlier() -> None:
    solved = solve_lengths(driven(np.where(np.arange(60) == 30, 0.5, 1.0)))
    assert np.flatnonzero(solved.contradicted).tolist() == [30]
    np.testing.assert_allclose(solved.length, 1.0, rtol=0.1)


def test_a_stretch_of_half_metres_is_said() -> None:
    """Learned depth alone cannot be overruled for ten steps, but no vehicle changes its speed so."""
    solved = solve_lengths(driven(np.where((np.arange(60) >= 30) & (np.arange(60) < 40), 0.5, 1.0)))
    said = np.flatnonzero(solved.contradicted)
    assert len(said) and set(said) <= set(range(28, 43))


def test_a_car_may_brake() -> None:
    """From 20 m/s at 8 m/s2 to 1 m/s."""
    metres = 0.1 * np.maximum(20.0 - 0.8 * np.arange(30), 1.0)
    solved = solve_lengths(driven(metres))
    assert not solved.contradicted.any()
    np.testing.assert_allclose(solved.length[1:-1], metres[1:-1], rtol=0.1)
