"""Steps by their two frames, whether they lead to the next frame or to a later one."""

from __future__ import annotations

import pytest

from slam.frames import Ends
from slam.frontend.step_table import links, path_between, shortest_by_start


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
