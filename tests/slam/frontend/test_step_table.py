"""Steps by their two frames, whether they lead to the next frame or to a later one."""

from __future__ import annotations

import numpy as np
import pytest

from slam.frames import Ends, RelativePose
from slam.frontend.step_table import StepTable, links, path_between, shortest_by_start
from slam.frontend.visual.motion import Motion
from slam.geometry.se3 import from_rotation_vector


def motion(first: int, last: int, length: float = 1.0, is_triangulated: bool = True) -> Motion:
    T = from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, length]))
    if is_triangulated:
        return Motion(RelativePose(first, last, T, np.full(6, 0.01), "essential"), np.eye(6))
    return Motion(RelativePose(first, last, T, np.full(6, 0.01), "pnp"))


def test_a_motion_is_kept_once_under_its_two_frames() -> None:
    table = StepTable.of([motion(0, 1), motion(0, 3), motion(1, 2), motion(0, 1, length=2.0)])
    assert len(table) == 3 and list(table.motions) == [(0, 1), (0, 3), (1, 2)]
    assert table.motions[0, 1].length_unscaled == pytest.approx(2.0)
    assert [pose.ends for pose in table.relative_poses] == [each.ends for each in table] == [(0, 1), (0, 3), (1, 2)]


def test_triangulated_steps_are_told_from_others() -> None:
    table = StepTable.of([motion(0, 1), motion(1, 4, is_triangulated=False), motion(4, 6)])
    assert list(table.triangulated) == [(0, 1), (4, 6)]


def test_replacing_and_removing_steps_leaves_the_table_as_it_was() -> None:
    table = StepTable.of([motion(0, 1), motion(1, 4), motion(4, 5), motion(5, 6)])
    replaced = table.replaced({(1, 4): motion(1, 4, length=5.0), (6, 9): motion(6, 9)})
    assert list(replaced.motions) == [(0, 1), (1, 4), (4, 5), (5, 6), (6, 9)]
    assert replaced.motions[1, 4].length_unscaled == pytest.approx(5.0)
    assert list(table.without_frames({5}).motions) == [(0, 1), (1, 4)]
    assert list(table.without_frames({2, 3}).motions) == list(table.motions)  # a step may lead over a removed frame
    assert len(table) == 4 and table.motions[1, 4].length_unscaled == pytest.approx(1.0)


def test_of_steps_that_begin_together_the_shortest_counts() -> None:
    assert shortest_by_start([(3, 7), (0, 2), (3, 4), (0, 5), (1, 9)]) == {0: (0, 2), 1: (1, 9), 3: (3, 4)}


@pytest.mark.parametrize(
    ("first", "last", "path"),
    [
        (0, 1, [(0, 1)]),
        (0, 6, [(0, 1), (1, 4), (4, 6)]),
        (1, 4, [(1, 4)]),
        (1, 6, [(1, 4), (4, 6)]),
        (4, 4, []),
        (0, 3, None),  # inside of a step
        (2, 4, None),  # no step begins there
        (1, 5, None),  # the last step leads further
        (4, 7, None),  # nothing leads on
    ],
)
def test_a_path_is_made_of_steps_that_follow_each_other(first: int, last: int, path: list[Ends] | None) -> None:
    by_start = shortest_by_start([(0, 1), (1, 4), (4, 6), (0, 4)])
    assert path_between(by_start, first, last) == path


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
def test_links_lead_from_the_first_frame_to_the_last(steps: list[Ends], frames: int, found: list[Ends]) -> None:
    assert links(steps, frames) == found
