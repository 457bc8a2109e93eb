"""Split files: those shipped, the notation of frames, and the errors."""

from __future__ import annotations

import pytest

from erfsfm.common.readers.frame_range import overlapping
from erfsfm.data.split_file import Split, read_split_file


@pytest.mark.parametrize(("name", "count"), [("eigen", 61), ("odometry", 11)])
def test_nothing_is_in_two_lists(name: str, count: int) -> None:
    split = read_split_file(name)
    assert split.train and split.validation
    assert overlapping([*split.train, *split.validation], split.test_recordings) == []
    assert overlapping(split.train, split.validation) == []
    everything = [*split.train, *split.validation, *split.test_recordings]
    assert len(set(everything)) == len(everything) == count


@pytest.mark.parametrize(
    ("runs", "frames"),
    [("3", [3]), ("0:3", [0, 1, 2]), ("0:7:3", [0, 3, 6]), ("0:7:3, 9,11:13", [0, 3, 6, 9, 11, 12])],
)
def test_runs(runs: str, frames: list[int]) -> None:
    assert Split(test=[f"kitti_raw/a[{runs}]"]).test_frames() == [("kitti_raw/a", frame) for frame in frames]
