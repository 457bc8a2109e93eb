"""A drive is parted at cuts and at long gaps."""

from __future__ import annotations

import numpy as np

from slam.frames import RelativePose
from slam.frontend.drive import Drive, Segment
from slam.frontend.keyframes.relative_poses import NO_MAPS, KeyframePoses
from slam.frontend.measured import Measured


def test_segments_begin_at_cuts_and_after_long_gaps_that_no_map_of_keyframes_relates():
    def segments(cuts: list[int], gap: range, maps: KeyframePoses = NO_MAPS) -> list[Segment]:
        dark, measured = dict.fromkeys(gap, "blank"), Measured(roads=[None] * 200)
        drive = Drive(measured, interpolated=dark, cuts=cuts, map_poses=maps)
        return drive.parted(np.eye(4)[None]).segments

    assert segments([], range(100, 120)) == [Segment(0, 199, "")]
    long, why = range(100, 140), "it shows another place than the frame before"
    after = Segment(140, 199, "40 frames before it are interpolated: blank")
    assert segments([50], long) == [Segment(0, 49, ""), Segment(50, 99, why), after]
    over = RelativePose(99, 140, np.eye(4), np.ones(6), "keyframes")
    maps = KeyframePoses([over], {99: 0, 140: 0})
    assert segments([50], long, maps) == [Segment(0, 49, ""), Segment(50, 199, why)]
