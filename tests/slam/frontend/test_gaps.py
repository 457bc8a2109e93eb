"""Gaps are interpolated with the motion around them, and with wide sigmas."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from oracle import snippets_of

from slam.frames import KEYFRAME_SOURCE, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.gaps import INTERPOLATED_SOURCE, complete_drive, find_cuts
from slam.frontend.keyframes.relative_poses import KeyframePoses
from slam.frontend.measured import Measured
from slam.frontend.network_motion import chain_raw
from slam.frontend.visual.motion import Motion
from slam.geometry.se3 import FloatArray, chain, from_rotation_vector, invert
from slam.graph.pose_graph import PoseGraph
from slam.runtime.errors import SlamError

COUNT = 40
STEP = from_rotation_vector(np.array([0.0, 0.02, 0.0]), np.array([0.0, 0.0, 1.0]))


def steady(count: int = COUNT) -> FloatArray:
    return chain(np.tile(STEP, (count - 1, 1, 1)))


def measured(T_world_camera: FloatArray, first: int, last: int) -> Motion:
    T_from_to = invert(T_world_camera[first]) @ T_world_camera[last]
    return Motion(RelativePose(first, last, T_from_to, np.full(6, 0.01), "essential"))


def closed(T_world_camera: FloatArray, unusable: set[int], *steps: Motion) -> Drive:
    return complete_drive(collected(T_world_camera, steps, unusable), 4)


def collected(
    T_world_camera: FloatArray,
    steps: Iterable[Motion] = (),
    unusable: Collection[int] = (),
    **others: Any,
) -> Measured:
    return Measured(
        {snippet.sources: snippet for snippet in snippets_of(T_world_camera, unusable=unusable)},
        {motion.ends: motion for motion in steps},
        roads=[None] * len(T_world_camera),
        unusable=dict.fromkeys(unusable, "black"),
        **others,
    )


def test_a_drive_without_gaps_stays_as_it_was():
    recorded = collected(steady(), [measured(steady(), 3, 4)])
    found = complete_drive(recorded, 4)
    assert found.snippets == [*recorded.snippets.values()] and found.steps == recorded.steps
    assert list(found.network_steps) == list(range(COUNT - 1))
    assert found.gap_steps == [] and found.interpolated == {}


@pytest.mark.parametrize(
    "gap", [{20}, set(range(15, 25)), {0}, {39}, {3, 20, 21}, {10, 12, 14, 16}]
)
def test_a_gap_of_a_steady_drive_is_interpolated_exactly(gap: set[int]):
    found = closed(steady(), gap)
    assert set(found.interpolated) == gap and found.interpolated[min(gap)] == "black"
    np.testing.assert_allclose(chain_raw(found.snippets, COUNT), steady(), atol=1e-9)
    assert not any(gap & {k, k + 1} for k in found.network_steps)
    for factor in found.gap_steps:
        np.testing.assert_allclose(factor.T_from_to, STEP, atol=1e-9)
        assert factor.source == INTERPOLATED_SOURCE and factor.to_index == factor.from_index + 1
        np.testing.assert_allclose(factor.sigmas, np.repeat([np.deg2rad(2.0), 0.5], 3), rtol=1e-6)
    linked = {f.from_index for f in found.gap_steps}
    assert linked | found.network_steps.keys() == set(range(COUNT - 1))


def test_a_gap_beside_steps_of_the_network_alone_has_the_unit_of_learned_depth():
    """The network's lengths are three quarters of those by learned depth."""
    short = steady()
    short[:, :3, 3] *= 0.75
    steps = [measured(steady(), k, k + 1) for k in (*range(14), *range(26, COUNT - 1))]
    found = closed(short, set(range(17, 23)), *steps)
    for factor in found.gap_steps:
        np.testing.assert_allclose(factor.T_from_to, STEP, atol=1e-9)
    np.testing.assert_allclose(chain_raw(found.snippets, COUNT), short, atol=1e-9)


def test_the_motion_changes_evenly_from_before_to_after():
    lengths = np.r_[np.full(19, 1.0), np.full(20, 3.0)]
    drive = chain(
        from_rotation_vector(
            np.zeros((39, 3)), np.stack([0 * lengths, 0 * lengths, lengths], axis=1)
        )
    )
    steps = {f.from_index: f.T_from_to[2, 3] for f in closed(drive, set(range(15, 25))).gap_steps}
    values = [steps[k] for k in range(14, 25)]
    assert values == sorted(values) and 1.0 < values[0] < 1.5 and 2.5 < values[-1] < 3.0


def test_a_step_over_a_gap_is_divided_into_equal_ones():
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


@pytest.mark.parametrize("is_one_map", [True, False])
def test_a_long_gap_ends_where_one_map_says(is_one_map: bool):
    """The camera was carried 2 m aside during 30 blank frames; constant velocity knows nothing of that."""
    blank, count = set(range(20, 50)), 60
    after = np.arange(count) >= 20
    centres = np.outer(np.arange(count), [0.01, 0.0, 0.0]) + np.outer(after, [0.0, 2.0, 1.0])
    truth = from_rotation_vector(np.outer(after, [0.3, 0.8, 0.1]), centres)
    mapped = [k for k in range(count) if k not in blank]
    numbers = {k: 0 if is_one_map or k < 20 else 1 for k in mapped}
    by_map = []
    for first, last in pairwise(mapped):
        if numbers[first] == numbers[last]:
            T = invert(truth[first]) @ truth[last]
            sigmas = np.full(6, max(0.02 * np.linalg.norm(T[:3, 3]), 1e-3))
            by_map.append(RelativePose(first, last, T, sigmas, KEYFRAME_SOURCE))
    guesses = complete_drive(
        collected(truth, (), blank), 4, KeyframePoses(by_map, numbers)
    ).gap_steps
    graph = PoseGraph()
    graph.add_relative(*guesses, *by_map)
    start = np.tile(np.eye(4), (count, 1, 1))
    for pose in [*guesses, *by_map]:
        start[pose.to_index] = start[pose.from_index] @ pose.T_from_to
    found = invert(start[0]) @ graph.optimise(start)
    errors = np.linalg.norm((found - invert(truth[0]) @ truth)[mapped, :3, 3], axis=1)
    assert (errors.max() < 0.01) == is_one_map
    sigmas = [pose.sigmas[3] for pose in guesses if pose.to_index in blank]
    np.testing.assert_allclose(sigmas, 0.5 * (2.27 if is_one_map else 0.01), rtol=0.01)


def test_steps_measured_by_image_geometry_are_not_interpolated():
    found = closed(steady(), {10, 12}, measured(steady(), 5, 6), measured(steady(), 8, 9))
    assert [f.from_index for f in found.gap_steps] == [9, 10, 11, 12]
    assert [f.from_index for f in closed(steady(), {2}).gap_steps] == [0, 1, 2]


def test_a_step_that_skips_usable_frames_does_not_change_the_interpolation():
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
    return complete_drive(collected(seen, steps, repeated=list(range(15, 25))), 4), true


def test_repeated_images_of_a_moving_camera_are_interpolated():
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


def test_repeated_images_of_a_standing_camera_are_measurements():
    found, _ = repeating(frozen=False)
    assert (
        found.interpolated == {} and found.gap_steps == [] and len(found.network_steps) == COUNT - 1
    )
    assert len(found.steps) == COUNT - 1


def test_repetition_to_the_end_is_standing_still():
    still = np.tile(np.eye(4), (COUNT, 1, 1))
    found = complete_drive(collected(still, repeated=list(range(1, COUNT))), 4)
    assert found.interpolated == {} and found.gap_steps == []


def test_without_any_snippet_there_is_one_error():
    with pytest.raises(SlamError, match="no 5 usable frames in a row among 40: black"):
        closed(steady(), set(range(3, COUNT, 4)))


def test_a_single_failed_step_between_measured_ones_is_a_cut():
    measured = [(k, k + 1) for k in range(9) if k != 4]
    assert find_cuts({(4, 5): 0.02}, measured, ()) == [5]
    assert find_cuts({(4, 5): 0.02}, measured, {5}) == [], "the image is unusable"
    two = [ends for ends in measured if ends != (5, 6)]
    assert find_cuts({(4, 5): 0.0, (5, 6): 0.0}, two, ()) == [], "one bad image fails two steps"
    assert find_cuts({(3, 5): 0.0}, measured, ()) == []
    assert find_cuts({(4, 5): 0.5}, measured, ()) == [], "half of the image is another car"
