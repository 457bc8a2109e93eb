"""The unit of a run and the lengths of its steps, by mode, on a drawn drive.

Lengths of all steps of a drive from ratios, road and learned depth.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.frames import Ends, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.measured import Measured
from slam.frontend.road import RoadStep
from slam.frontend.scale import (
    Scale,
    ScaleEstimate,
    StepEvidence,
    Unit,
    find_scale,
    gather_evidence,
    marginals,
    solve_lengths,
)
from slam.frontend.visual.motion import Motion
from slam.geometry import se3
from slam.geometry.se3 import from_rotation_vector
from slam.runtime.errors import Failed

DOWN = np.array([0.0, 1.0, 0.0])
HEIGHT_M = 1.65
UNIT = 0.05  # unscaled lengths per metre
STEPS_M = 1.0 + 0.2 * np.sin(np.arange(60) / 6.0)
FRAMES = len(STEPS_M) + 1
SINGLE = [(k, k + 1) for k in range(FRAMES - 1)]
STEPS = 200
RATIO_WIDENING, CORRELATED_WIDENING = (
    1.5,
    1.5,
)  # of the sigmas of ratios, and of those in the pose graph
TRUE = 1.0 + 0.3 * np.sin(np.arange(STEPS) / 15.0)


def metres(ends: Ends) -> float:
    """True length of a straight step."""
    return float(STEPS_M[ends[0] : ends[1]].sum())


def step(ends: Ends, unit: float, source: str) -> RelativePose:
    T = se3.from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, unit * metres(ends)]))
    return RelativePose(*ends, T, np.ones(6), source)


def measured(
    road=True,
    planes=True,
    bias: float = 1.0,
    lidar: int = 0,
    height_m: float = HEIGHT_M,
    steps=SINGLE,
) -> tuple[Drive, list[RelativePose]]:
    """A straight drive; ``bias`` makes the learned road lie too near, the first ``lidar`` steps have scans."""
    motions = {ends: Motion(step(ends, UNIT, "essential"), np.eye(6)) for ends in steps}
    plane = bias * HEIGHT_M * UNIT if planes else None
    roads = (
        {ends: RoadStep(metres(ends) / height_m * DOWN, np.eye(3), DOWN, 0.06) for ends in steps}
        if road
        else {}
    )
    scans = [step(ends, 1.0, "lidar") for ends in SINGLE[:lidar]]
    return Drive(Measured(roads=[plane] * FRAMES), motions, roads), scans


def find(
    mode, measurements: tuple[Drive, list[RelativePose]], height_m: float | None = HEIGHT_M
) -> Scale:
    """Modes that know metres after an odometry know no height here."""
    is_stated = mode in ("camera-height", "lidar")
    return find_scale(Unit(mode, height_m if is_stated else None), *measurements)


def assert_lengths(scale: Scale, expected: dict[Ends, float], rtol: float) -> None:
    found = {ends: length.value for ends, length in scale.lengths.items()}
    assert found.keys() == expected.keys()
    np.testing.assert_allclose(
        [found[ends] for ends in expected], list(expected.values()), rtol=rtol
    )


TRUE_M = {ends: metres(ends) for ends in SINGLE}


@pytest.mark.parametrize(
    ("mode", "unit_m"), [("camera-height", 1.0), ("none", HEIGHT_M), ("reference", HEIGHT_M)]
)
@pytest.mark.parametrize("planes", [True, False])
def test_the_road_in_the_image_outweighs_the_learned_road(mode, unit_m, planes):
    scale = find(mode, measured(planes=planes, bias=0.7))
    assert_lengths(scale, {ends: length / unit_m for ends, length in TRUE_M.items()}, rtol=0.02)
    np.testing.assert_allclose(scale.per_frame * unit_m, 1 / UNIT, rtol=0.03)
    assert isinstance(scale.estimate, ScaleEstimate)
    assert scale.estimate.frames_used == len(STEPS_M) and scale.estimate.spread < 0.02


def test_a_car_taken_for_the_road_for_half_the_drive_is_left_out():
    drive, scans = measured()
    roads = dict(drive.road_steps)
    for ends in SINGLE[:30]:
        roads[ends] = replace(roads[ends], plane=0.1 * metres(ends) * DOWN)
    drive = replace(drive, road_steps=roads)
    scale = find("camera-height", (drive, scans))
    assert_lengths(scale, TRUE_M, rtol=0.03)
    for length in scale.lengths.values():
        assert 0 < length.relative_sigma <= length.relative_correlated_sigma


def test_the_leap_of_a_unit_is_known():
    """From step 30 on all lengths are half of what they are."""
    drive, scans = measured()
    steps, roads = {}, dict(drive.road_steps)
    for ends in SINGLE:
        unit = UNIT if ends[0] < 30 else 0.5 * UNIT
        moved = Motion(step(ends, unit, "essential"), np.eye(6), seconds=0.1)
        steps[ends] = replace(moved, length_ratio=(0.0, 0.02))
    for ends in SINGLE[30:]:
        roads[ends] = replace(roads[ends], plane=0.5 * roads[ends].plane)
    scale = find("camera-height", (replace(drive, steps=steps, road_steps=roads), scans))
    assert scale.contradicted[30, 31] == pytest.approx(-np.log(2.0), abs=0.1)


def test_without_a_road_in_the_image_the_learned_road_stands():
    scale = find("camera-height", measured(road=False))
    assert_lengths(scale, TRUE_M, rtol=1e-4)
    assert isinstance(scale.estimate, ScaleEstimate)


def test_without_any_road_lengths_stay_unscaled():
    scale = find("camera-height", measured(road=False, planes=False))
    assert isinstance(scale.estimate, Failed)
    np.testing.assert_allclose(scale.per_frame, 1.0, rtol=1e-12)
    assert_lengths(scale, {ends: UNIT * length for ends, length in TRUE_M.items()}, rtol=1e-6)


@pytest.mark.parametrize("height_m", [0.35, 1.65, 3.2])
def test_lidar_gives_metres_where_no_road_step_and_no_height_is_known(height_m):
    scale = find("lidar", measured(road=False, bias=height_m / HEIGHT_M, lidar=20), None)
    assert scale.is_metric
    assert_lengths(scale, {ends: metres(ends) for ends in SINGLE}, 0.01)


def test_lidar_measures_its_steps_and_the_height_for_the_others():
    """The camera is really 2 m high; the height given is missing or wrong."""
    for given in (None, HEIGHT_M):
        scale = find("lidar", measured(lidar=20, height_m=2.0), given)
        assert_lengths(scale, TRUE_M, rtol=0.02)


def test_steps_that_skip_frames_have_lengths_by_their_two_frames():
    """Steps of three frames in the middle, and frames 40 to 45 without a step at all."""
    steps = [*SINGLE[:15], *((k, k + 3) for k in range(15, 39, 3)), (39, 40), *SINGLE[45:]]
    scale = find("camera-height", measured(bias=0.7, steps=steps))
    assert_lengths(scale, {ends: metres(ends) for ends in steps}, rtol=0.02)
    np.testing.assert_allclose(
        scale.per_frame, 1 / UNIT, rtol=0.04
    )  # of 36 %: few steps against the learned road
    assert scale.estimate.frames_used == len(steps)
    unscaled = find("camera-height", measured(road=False, planes=False, steps=steps))
    assert_lengths(unscaled, {ends: UNIT * metres(ends) for ends in steps}, rtol=1e-6)


def test_lengths_by_learned_depth_alone_have_the_unit_at_their_first_frames():
    """The unit of learned depth drifts by half, of which planes of 20 steps alone see a little."""
    steps = [(k, k + 3) for k in range(0, FRAMES - 1, 3)]
    drifting = np.linspace(1.0, 1.5, FRAMES)
    planes = [HEIGHT_M * UNIT / unit for unit in drifting]
    scale = find(
        "camera-height",
        (replace(measured(road=False, steps=steps)[0], measured=Measured(roads=planes)), []),
    )
    assert scale.per_frame[-1] > 1.005 * scale.per_frame[0]
    for ends in steps:
        assert scale.lengths[ends].value == pytest.approx(
            scale.per_frame[ends[0]] * UNIT * metres(ends), rel=1e-5
        )


def test_the_unit_is_that_of_the_first_frame_of_a_measurement():
    scale = find("camera-height", measured())
    drifting = replace(scale, per_frame=np.arange(1.0, FRAMES + 1))
    ahead = np.array([0.0, 0.0, 1.0])
    for first, last, unit in ((4, 7, 5.0), (9, 6, 7.0)):
        measured_pose = RelativePose(first, last, se3.make(np.eye(3), ahead), np.ones(6), "network")
        np.testing.assert_allclose(drifting.scaled(measured_pose).T_from_to[:3, 3], unit * ahead)


@pytest.mark.parametrize(("share", "unit"), [(0.3, "no metric unit"), (0.7, "camera heights")])
def test_a_floor_seen_now_and_then_gives_no_metric_unit(share, unit):
    drive, scans = measured(road=False)
    seen = int(share * FRAMES)
    roads = [*drive.measured.roads[:seen], *[None] * (FRAMES - seen)]
    drive = replace(drive, measured=Measured(roads=roads))
    scale = find("none", (drive, scans), None)
    assert scale.unit == scale.unit_name == unit
    assert isinstance(scale.estimate, ScaleEstimate) and scale.estimate.frames_used == seen


@pytest.mark.parametrize(
    ("mode", "road", "unit"),
    [
        ("camera-height", True, "metres"),
        ("camera-height", False, "the networks' own unit"),
        ("none", True, "camera heights"),
        ("none", False, "the networks' own unit"),
        ("gps", True, "camera heights"),
        ("gps", False, "the networks' own unit"),
    ],
)
def test_lengths_have_the_unit_that_was_measured(mode, road, unit):
    scale = find(mode, measured(road=road, planes=road))
    assert scale.unit == unit


def evidence(**measured: np.ndarray) -> StepEvidence:
    return replace(StepEvidence.empty(STEPS), **measured)


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
        absolute=road,
        absolute_sigma=np.full(STEPS, 0.06),
        learned=noisy(0.05) + np.log(2.0),
        **ratios(0.003),
    )
    solved = solve_lengths(measured)
    np.testing.assert_allclose(solved.length, TRUE, rtol=0.05)
    np.testing.assert_allclose(solved.unit_correction, 0.5, rtol=0.1)


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
    solved = solve_lengths(
        evidence(absolute=road, absolute_sigma=np.full(STEPS, 0.06), learned=learned, **tied)
    )
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
    return Motion(
        RelativePose(*ends, T, np.full(6, 0.01), "essential"),
        np.eye(6),
        (np.log(ratio), 0.01),
        seconds,
    )


def test_sigmas_are_those_of_the_whole_system():
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
    both_sides = 0.5 * (
        np.append(correlations[0], correlations) + np.append(correlations, correlations[-1])
    )
    np.testing.assert_allclose(with_neighbours, both_sides, atol=1e-9)


def test_correlated_sigmas_are_those_of_sums_of_lengths(monkeypatch):
    """Over 40 steps, independent errors of ``relative_correlated_sigma`` add up as the errors of the lengths do."""
    monkeypatch.setattr("slam.frontend.scale.OUTLIER_SIGMAS", 1e9)
    middle = slice(80, 120)
    alone, together = [], []
    for seed in range(60):
        absolute = {
            "absolute": noisy(0.06, seed=300 + seed),
            "absolute_sigma": np.full(STEPS, 0.06),
        }
        solved = solve_lengths(evidence(**absolute, **chained(0.02, seed)))
        summed = np.log(solved.length / TRUE)[middle].sum()
        alone.append(summed / np.linalg.norm(solved.relative_sigma[middle]))
        together.append(
            CORRELATED_WIDENING * summed / np.linalg.norm(solved.relative_correlated_sigma[middle])
        )
    assert 0.75 < np.sqrt(np.square(together).mean()) < 1.3
    assert np.sqrt(np.square(alone).mean()) > 1.5


def test_sigmas_are_those_of_the_errors_of_lengths(monkeypatch):
    """Also in the middle of a gap of the road, where there are only triangulation and learned depth."""
    monkeypatch.setattr("slam.frontend.scale.OUTLIER_SIGMAS", 1e9)
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


def test_planes_hold_the_unit_where_the_road_gives_few_lengths():
    """The unit of learned depth drifts by half, ratios by chance, and the road is seen in ten steps alone."""
    drift = np.linspace(0.0, 0.4, STEPS)
    road = np.where(np.arange(STEPS) < 10, np.log(TRUE), np.nan)
    known = ratios(0.01) | {"learned": np.log(TRUE) + drift, "absolute": road}
    known["absolute_sigma"] = np.full(STEPS, 0.06)
    alone, by_planes = (
        np.log(solve_lengths(evidence(**known, plane=plane)).length / TRUE)[-1]
        for plane in (np.full(STEPS, np.nan), -drift)
    )
    assert abs(by_planes) < 0.5 * abs(alone)


def driven(metres: np.ndarray) -> StepEvidence:
    """Steps of a tenth of a second, their lengths by learned depth alone."""
    links = [(k, k + 1) for k in range(len(metres))]
    motions = {ends: motion(ends, metres[ends[0]], 0.1, 1.0, seconds=0.1) for ends in links}
    motions = {ends: replace(step, length_ratio=None) for ends, step in motions.items()}
    return gather_evidence(links, motions, {}, 10.0)


def test_a_step_of_half_a_metre_between_metres_is_an_outlier():
    solved = solve_lengths(driven(np.where(np.arange(60) == 30, 0.5, 1.0)), 1.65)
    assert np.flatnonzero(solved.contradicted).tolist() == [30]
    np.testing.assert_allclose(solved.length, 1.0, rtol=0.1)


def test_a_stretch_of_half_metres_is_said_and_overruled():
    """For ten steps learned depth loses its unit, but no vehicle changes its speed so."""
    solved = solve_lengths(
        driven(np.where((np.arange(60) >= 30) & (np.arange(60) < 40), 0.5, 1.0)), 1.65
    )
    said = np.flatnonzero(solved.contradicted)
    assert len(said) and set(said) <= set(range(28, 43))
    assert solved.length.max() / solved.length.min() < 1.15


def test_a_car_may_brake():
    """From 20 m/s at 8 m/s2 to 1 m/s."""
    metres = 0.1 * np.maximum(20.0 - 0.8 * np.arange(30), 1.0)
    solved = solve_lengths(driven(metres), 1.65)
    assert not solved.contradicted.any()
    np.testing.assert_allclose(solved.length[1:-1], metres[1:-1], rtol=0.12)


@pytest.mark.parametrize("stood", [False, True])
def test_a_unit_that_learned_depth_loses_over_a_gap_is_held_by_the_speed(stood):
    """20 m/s, six steps that nobody measured, then learned depth of a third, tied by points; or a stop between.

    Learned depth wanders, as on a road that the network does not know.
    """
    metres = np.where(np.arange(80) < 40, 2.0, 0.7) * np.exp(0.3 * np.sin(np.arange(80) / 6))
    evidence = driven(metres)
    evidence.ratio[1:], evidence.ratio_sigma[1:] = 0.0, 0.005
    gap = slice(40, 46)
    for values in (evidence.learned, evidence.ratio, evidence.ratio_sigma):
        values[gap] = np.nan
    evidence.ratio[46] = np.nan
    evidence.absolute[:30], evidence.absolute_sigma[:30] = np.log(2.0), 0.02
    if stood:
        evidence.seconds[gap] = np.nan
    after = solve_lengths(evidence, 1.65).length[50:]
    assert (after < 1.0).all() if stood else (after > 1.7).all()
