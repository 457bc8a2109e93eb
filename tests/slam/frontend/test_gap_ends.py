from itertools import pairwise

import numpy as np

from slam.frames import KEYFRAME_SOURCE, RelativePose
from slam.frontend.gap_interpolation import INTERPOLATED_SOURCE, join_gap_ends
from slam.geometry.se3 import FloatArray, from_rotation_vector, invert
from slam.graph.pose_graph import PoseGraph


def relative(T_world_camera: FloatArray, first: int, last: int, sigma: float, source: str) -> RelativePose:
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
    guesses = [RelativePose(k, k + 1, step, np.full(6, 0.005), INTERPOLATED_SOURCE) for k in range(before - 1, after)]
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
    by_map = [relative(truth, 0, 1, 0.01, KEYFRAME_SOURCE), relative(truth, 2, 3, 0.01, KEYFRAME_SOURCE)]
    (found,) = join_gap_ends([guess], [], by_map, {0: 0, 1: 0, 2: 1, 3: 1})
    assert found is guess
