"""A drive is cut where a single step failed, and parted at long gaps."""

from __future__ import annotations

from slam.frontend.drive import Segment, find_cuts, find_segments

STEPS = [(k, k + 1) for k in range(9)]


def test_a_single_failed_step_between_measured_ones_is_a_cut():
    measured = [ends for ends in STEPS if ends != (4, 5)]
    assert find_cuts({(4, 5): 0.02}, measured, ()) == [5]
    assert find_cuts({(4, 5): 0.02}, measured, {5}) == [], "the image is unusable"
    two = [ends for ends in measured if ends != (5, 6)]
    assert find_cuts({(4, 5): 0.0, (5, 6): 0.0}, two, ()) == [], "one bad image fails two steps"
    assert find_cuts({(3, 5): 0.0}, measured, ()) == []
    assert find_cuts({(4, 5): 0.5}, measured, ()) == [], "half of the image is another car"


def test_segments_begin_at_cuts_and_after_long_gaps_that_no_map_of_keyframes_relates():
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
