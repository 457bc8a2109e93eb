"""Gaps are interpolated with the motion around them, and with wide sigmas.

Rotations of steps corrected by relative rotations across several of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from oracle import snippets_of
from scipy.spatial.transform import Rotation

from slam.frames import KEYFRAME_SOURCE, Ends, RelativePose, SnippetPoses
from slam.frontend.completion import (
    INTERPOLATED_SOURCE,
    find_cuts,
    find_segments,
    interpolate_gaps,
    smooth_rotations,
)
from slam.frontend.drive import Drive, Segment
from slam.frontend.factors import chain_raw, join_gap_ends
from slam.frontend.visual.motion import Motion, RelativeRotation, Steps
from slam.geometry.se3 import FloatArray, chain, from_rotation_vector, invert, make
from slam.graph.pose_graph import PoseGraph
from slam.runtime.errors import Failed, SlamError

COUNT = 40
STEP = from_rotation_vector(np.array([0.0, 0.02, 0.0]), np.array([0.0, 0.0, 1.0]))
SIGMA = np.deg2rad(0.02)
ROTATIONS = 40
T_CURRENT_PREVIOUS = np.array([0.1, 0.0, -1.2])  # translation of every step


def steady(count: int = COUNT) -> FloatArray:
    return chain(np.tile(STEP, (count - 1, 1, 1)))


def measured(T_world_camera: FloatArray, first: int, last: int) -> Motion:
    T_from_to = invert(T_world_camera[first]) @ T_world_camera[last]
    return Motion(RelativePose(first, last, T_from_to, np.full(6, 0.01), "essential"))


def closed(T_world_camera: FloatArray, unusable: set[int], *steps: Motion) -> Drive:
    reasons = dict.fromkeys(unusable, "black")
    return interpolate_gaps(
        collected(snippets_of(T_world_camera, unusable=unusable), steps, unusable=reasons), 4
    )


def collected(snippets: list[SnippetPoses], steps: Iterable[Motion] = (), **others: Any) -> Drive:
    roads = [Failed("not drawn")] * COUNT
    return Drive(snippets=snippets, motions=list(steps), roads=roads, **others)


def test_a_drive_without_gaps_stays_as_it_was() -> None:
    snippets, steps = snippets_of(steady()), [measured(steady(), 3, 4)]
    found = interpolate_gaps(collected(snippets, steps), 4)
    assert found.snippets == found.trusted == snippets and found.motions == steps
    assert found.gap_steps == [] and found.interpolated == {}


@pytest.mark.parametrize(
    "gap", [{20}, set(range(15, 25)), {0}, {39}, {3, 20, 21}, {10, 12, 14, 16}]
)
def test_a_gap_of_a_steady_drive_is_interpolated_exactly(gap: set[int]) -> None:
    found = closed(steady(), gap)
    assert set(found.interpolated) == gap and found.interpolated[min(gap)] == "black"
    np.testing.assert_allclose(chain_raw(found.snippets, COUNT), steady(), atol=1e-9)
    assert not any(gap & {s.target, *s.sources} for s in found.trusted)
    for factor in found.gap_steps:
        np.testing.assert_allclose(factor.T_from_to, STEP, atol=1e-9)
        assert factor.source == INTERPOLATED_SOURCE and factor.to_index == factor.from_index + 1
        np.testing.assert_allclose(factor.sigmas, np.repeat([np.deg2rad(2.0), 0.5], 3), rtol=1e-6)
    linked = {f.from_index for f in found.gap_steps}
    linked |= {step for s in found.trusted for step in range(min(s.sources), max(s.sources))}
    assert linked == set(range(COUNT - 1))


def test_a_gap_beside_steps_of_the_network_alone_has_the_unit_of_learned_depth() -> None:
    """The network's lengths are three quarters of those by learned depth."""
    short = steady()
    short[:, :3, 3] *= 0.75
    steps = [measured(steady(), k, k + 1) for k in (*range(14), *range(26, COUNT - 1))]
    unusable = set(range(17, 23))
    found = interpolate_gaps(
        collected(
            snippets_of(short, unusable=unusable), steps, unusable=dict.fromkeys(unusable, "black")
        ),
        4,
    )
    for factor in found.gap_steps:
        np.testing.assert_allclose(factor.T_from_to, STEP, atol=1e-9)
    np.testing.assert_allclose(chain_raw(found.snippets, COUNT), short, atol=1e-9)


def test_the_motion_changes_evenly_from_before_to_after() -> None:
    lengths = np.r_[np.full(19, 1.0), np.full(20, 3.0)]
    drive = chain(
        from_rotation_vector(
            np.zeros((39, 3)), np.stack([0 * lengths, 0 * lengths, lengths], axis=1)
        )
    )
    steps = {f.from_index: f.T_from_to[2, 3] for f in closed(drive, set(range(15, 25))).gap_steps}
    values = [steps[k] for k in range(14, 25)]
    assert values == sorted(values) and 1.0 < values[0] < 1.5 and 2.5 < values[-1] < 3.0


def test_a_step_over_a_gap_is_divided_into_equal_ones() -> None:
    drive = steady()
    drive[25:] = (
        drive[14]
        @ from_rotation_vector(np.array([0.0, 0.4, 0.0]), np.array([1.0, 0.0, 5.0]))
        @ drive[:15]
    )
    over_gap = measured(drive, 14, 25)
    found = closed(drive, set(range(15, 25)), over_gap)
    inside = [f.T_from_to for f in found.gap_steps if 14 <= f.from_index < 25]
    np.testing.assert_allclose(
        chain(np.array(inside))[-1], over_gap.relative_pose.T_from_to, atol=1e-9
    )
    assert found.steps[14, 25] is over_gap


def test_steps_measured_by_image_geometry_are_not_interpolated() -> None:
    found = closed(steady(), {10, 12}, measured(steady(), 5, 6), measured(steady(), 8, 9))
    assert [f.from_index for f in found.gap_steps] == [9, 10, 11, 12]
    assert [f.from_index for f in closed(steady(), {2}).gap_steps] == [0, 1, 2]


def test_a_step_that_skips_usable_frames_does_not_change_the_interpolation() -> None:
    """A step from a keyframe beside those from frame to frame; its frames are measured by the network."""
    without, beside = closed(steady(), {20}), closed(steady(), {20}, measured(drifting(), 5, 11))
    assert [f.ends for f in beside.gap_steps] == [f.ends for f in without.gap_steps]
    for one, other in zip(without.gap_steps, beside.gap_steps, strict=True):
        np.testing.assert_array_equal(one.T_from_to, other.T_from_to)
    assert list(beside.steps) == [(5, 11)]


def drifting() -> FloatArray:
    return chain(
        np.tile(
            from_rotation_vector(np.array([0.0, 0.1, 0.0]), np.array([0.0, 0.0, 2.0])),
            (COUNT - 1, 1, 1),
        )
    )


def repeating(frozen: bool) -> tuple[Drive, FloatArray]:
    """Ten repeated images: the camera moved, or stood."""
    T_steps = np.tile(STEP, (COUNT - 1, 1, 1))
    if not frozen:
        T_steps[14:24] = np.eye(4)
    true = chain(T_steps)
    seen = true.copy()
    seen[15:25] = seen[14]
    steps = [measured(seen, k, k + 1) for k in range(COUNT - 1)]
    return interpolate_gaps(
        collected(snippets_of(seen), steps, repeated=list(range(15, 25))), 4
    ), true


def test_repeated_images_of_a_moving_camera_are_interpolated() -> None:
    found, true = repeating(frozen=True)
    assert (
        set(found.interpolated) == set(range(15, 25)) and "stands still" in found.interpolated[15]
    )
    assert [f.from_index for f in found.gap_steps] == list(range(14, 25))
    np.testing.assert_allclose(
        chain(np.array([f.T_from_to for f in found.gap_steps])), true[:12], atol=1e-9
    )
    assert [ends for ends in found.steps if ends[1] - ends[0] > 1] == [(14, 25)]
    assert not any(set(range(15, 25)).intersection(ends) for ends in found.steps)


def test_repeated_images_of_a_standing_camera_are_measurements() -> None:
    found, _ = repeating(frozen=False)
    assert found.interpolated == {} and found.gap_steps == [] and len(found.trusted) == COUNT - 4
    assert len(found.steps) == COUNT - 1


def test_repetition_to_the_end_is_standing_still() -> None:
    still = np.tile(np.eye(4), (COUNT, 1, 1))
    found = interpolate_gaps(collected(snippets_of(still), repeated=list(range(1, COUNT))), 4)
    assert found.interpolated == {} and found.gap_steps == []


def test_without_any_snippet_there_is_one_error() -> None:
    reasons = dict.fromkeys(range(3, COUNT, 4), "image 3 is truncated")
    with pytest.raises(
        SlamError, match="no 5 usable frames in a row among 40: image 3 is truncated"
    ):
        interpolate_gaps(collected([], unusable=reasons), 4)


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


STEPS = [(k, k + 1) for k in range(9)]


def test_a_single_failed_step_between_measured_ones_is_a_cut() -> None:
    measured = [ends for ends in STEPS if ends != (4, 5)]
    assert find_cuts([(4, 5, "no corners")], measured, ()) == [5]
    assert find_cuts([(4, 5, "no corners")], [*measured, (3, 5)], ()) == [], (
        "a longer step measures across it"
    )
    assert find_cuts([(4, 5, "no corners")], measured, {5}) == [], "the image is unusable"
    two = [ends for ends in measured if ends != (5, 6)]
    assert find_cuts([(4, 5, ""), (5, 6, "")], two, ()) == [], "one bad image fails two steps"
    assert find_cuts([(3, 5, "")], measured, ()) == []


def test_segments_begin_at_cuts_and_after_long_gaps_that_no_map_of_keyframes_relates() -> None:
    def never(_: int) -> bool:
        return False

    assert find_segments(10, [], {}, never) == [Segment(0, 9, "")]
    dark = dict.fromkeys(range(100, 140), "blank")
    assert find_segments(200, [50], dark, never) == [
        Segment(0, 49, ""),
        Segment(50, 99, "it shows another place than the frame before"),
        Segment(140, 199, "40 frames before it are interpolated: blank"),
    ]
    assert len(find_segments(200, [], dict.fromkeys(range(100, 120), "blank"), never)) == 1
    assert find_segments(200, [50], dark, lambda first: first == 140) == [
        Segment(0, 49, ""),
        Segment(50, 199, "it shows another place than the frame before"),
    ]


def small(rng: np.random.Generator, sigma: float) -> FloatArray:
    return Rotation.from_rotvec(rng.normal(0.0, sigma, 3)).as_matrix()


def true_rotations(rng: np.random.Generator) -> list[FloatArray]:
    """``R_current_previous`` of a drive that turns by up to 4 degrees a step."""
    return [
        Rotation.from_euler("y", 4.0 * np.sin(0.3 * k), degrees=True).as_matrix()
        @ small(rng, 0.005)
        for k in range(ROTATIONS)
    ]


def table_of(rotations: Mapping[Ends, FloatArray], correlation: float = 0.0) -> Steps:
    """Triangulated steps with these ``R_current_previous``; turning right by an angle moves them right by two."""
    sigmas = np.repeat([SIGMA, 0.01], 3)
    covariance = SIGMA**2 * np.diag([1.0, 1.0, 1.0, 4.0, 4.0, 4.0])
    covariance[1, 3] = covariance[3, 1] = 2.0 * correlation * SIGMA**2
    return {
        ends: Motion(
            RelativePose(*ends, invert(make(R, T_CURRENT_PREVIOUS)), sigmas, "essential"),
            covariance,
        )
        for ends, R in rotations.items()
    }


def single(rotations: list[FloatArray]) -> Steps:
    return table_of({(k, k + 1): R for k, R in enumerate(rotations)})


def rotations_of(table: Steps) -> dict[Ends, FloatArray]:
    return {
        motion.ends: invert(motion.relative_pose.T_from_to)[:3, :3] for motion in table.values()
    }


def error_deg(table: Steps, truth: list[FloatArray]) -> float:
    """Of the rotation of the whole drive."""
    R, R_true, rotations = np.eye(3), np.eye(3), rotations_of(table)
    for k in range(ROTATIONS):
        R, R_true = rotations[k, k + 1] @ R, truth[k] @ R_true
    return float(np.rad2deg(Rotation.from_matrix(R @ R_true.T).magnitude()))


def drive(
    bias: FloatArray, baseline_noise: float, seed: int = 0
) -> tuple[Steps, list[RelativeRotation], list[FloatArray]]:
    """Steps with a rotation error of ``bias`` each, and rotations across two steps with the same error."""
    rng = np.random.default_rng(seed)
    truth, off = true_rotations(rng), Rotation.from_rotvec(bias).as_matrix()
    sigmas = np.full(3, SIGMA)
    steps = single([off @ small(rng, 0.1 * SIGMA) @ R for R in truth])
    across = [
        RelativeRotation(
            (k, k + 2), off @ small(rng, baseline_noise) @ truth[k + 1] @ truth[k], sigmas
        )
        for k in range(ROTATIONS - 1)
    ]
    return steps, across, truth


@pytest.mark.parametrize("axis", range(3))
def test_a_bias_of_every_measurement_counts_half_as_often_over_two_steps(axis: int) -> None:
    steps, across, truth = drive(SIGMA * np.eye(3)[axis], 0.1 * SIGMA)
    assert error_deg(smooth_rotations(steps, across), truth) < 0.65 * error_deg(steps, truth)


def test_a_relative_rotation_that_is_far_off_is_an_outlier() -> None:
    steps, across, truth = drive(np.zeros(3), 0.1 * SIGMA)
    before = error_deg(smooth_rotations(steps, across), truth)
    wrong = Rotation.from_euler("y", 5.0, degrees=True).as_matrix() @ across[10].R_to_from
    across[10] = RelativeRotation((10, 12), wrong, across[10].sigmas)
    assert error_deg(smooth_rotations(steps, across), truth) < before + 0.02


def test_steps_that_are_not_triangulated_stay_and_are_not_crossed() -> None:
    steps, across, _ = drive(np.array([SIGMA, 0.0, 0.0]), 0.1 * SIGMA)
    by_points = Motion(steps[20, 21].relative_pose)
    smoothed = smooth_rotations({**steps, (20, 21): by_points}, across)
    assert smoothed[20, 21] is by_points
    without = smooth_rotations({e: m for e, m in steps.items() if e != (20, 21)}, across)
    for ends, R in rotations_of(without).items():
        np.testing.assert_array_equal(R, rotations_of(smoothed)[ends])


def test_directions_follow_rotations_as_far_as_they_are_correlated() -> None:
    biased, across, _ = drive(np.array([0.0, SIGMA, 0.0]), 0.1 * SIGMA)
    for correlation in (0.0, 0.9):
        steps = table_of(rotations_of(biased), correlation)
        smoothed = smooth_rotations(steps, across)
        for before, after in zip(steps.values(), smoothed.values(), strict=True):
            R, R_before = (
                invert(motion.relative_pose.T_from_to)[:3, :3] for motion in (after, before)
            )
            turned = Rotation.from_matrix(R @ R_before.T).as_rotvec()[1]
            seen = invert(after.relative_pose.T_from_to)[:3, 3]
            assert np.abs(turned) > 0.1 * SIGMA
            assert np.linalg.norm(seen) == pytest.approx(np.linalg.norm(T_CURRENT_PREVIOUS))
            moved = (seen - T_CURRENT_PREVIOUS)[0] / np.linalg.norm(T_CURRENT_PREVIOUS)
            assert moved == pytest.approx(2.0 * correlation * turned, rel=0.02, abs=1e-12)
            np.testing.assert_array_equal(after.relative_pose.sigmas, before.relative_pose.sigmas)


def test_steps_that_skip_frames_are_smoothed_like_others() -> None:
    """The same drive, whose frames are numbered three apart: every step skips two frames."""
    steps, across, truth = drive(np.array([SIGMA, 0.0, 0.0]), 0.1 * SIGMA)
    expected = rotations_of(smooth_rotations(steps, across))
    sparse = table_of({(3 * k, 3 * k + 3): R for (k, _), R in rotations_of(steps).items()})
    sparse_across = [
        RelativeRotation((3 * each.ends[0], 3 * each.ends[1]), each.R_to_from, each.sigmas)
        for each in across
    ]
    for (first, _), R in rotations_of(smooth_rotations(sparse, sparse_across)).items():
        np.testing.assert_allclose(R, expected[first // 3, first // 3 + 1], atol=1e-12)
    ends_inside = [
        RelativeRotation((k, k + 4), truth[0], np.full(3, SIGMA)) for k in range(0, 60, 3)
    ]
    assert smooth_rotations(sparse, ends_inside) is sparse
