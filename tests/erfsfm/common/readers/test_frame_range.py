"""Names of frames where the recording has brackets in its own name."""

from __future__ import annotations

import pytest

from erfsfm.common.errors import ConfigError
from erfsfm.common.readers.frame_range import EVERYTHING, FrameRange
from erfsfm.data.splits import merge, overlapping


@pytest.mark.parametrize(
    ("name", "recording", "start", "stop"),
    [
        ("folder/br[ack]ets[0:10]", "folder/br[ack]ets", 0, 10),
        ("folder/br[ack]ets", "folder/br[ack]ets", 0, EVERYTHING),
        ("folder/drive[1][5:]", "folder/drive[1]", 5, EVERYTHING),
        ("folder/cut[0:5][2:3]", "folder/cut[0:5]", 2, 3),
        ("tum/[desk]", "tum/[desk]", 0, EVERYTHING),
        ("kitti_odometry/br[ack][1:2]", "kitti_odometry/br[ack]", 1, 2),
    ],
)
def test_the_range_is_read_from_the_right(name: str, recording: str, start: int, stop: int) -> None:
    span = FrameRange.parse(name)
    assert span == FrameRange(recording, start, stop)
    assert FrameRange.parse(str(span)) == span


def test_a_whole_recording_with_a_range_for_a_name_keeps_its_name() -> None:
    whole = FrameRange("folder/cut[0:5]", 0, EVERYTHING)
    assert FrameRange.parse(str(whole)) == whole


def test_leaks_of_bracketed_names() -> None:
    assert overlapping(["folder/br[ack]ets[0:10]"], ["folder/br[ack]ets[5:20]"]) == ["folder/br[ack]ets[0:10]"]
    assert overlapping(["folder/br[ack]ets[0:5]"], ["folder/br[ack]ets[5:20]"]) == []
    record = merge(["folder/br[ack]ets[0:10]", "folder/br[ack]ets"])
    assert merge(record) == record


def test_leaks_of_videos_in_one_folder() -> None:
    clips = ["folder/trip/clip1[0:30]", "folder/trip/clip2[0:30]"]
    assert overlapping(clips, ["folder/trip/clip1[20:40]"]) == clips[:1]
    assert overlapping(clips, ["folder/trip[20:40]"]) == clips, "of a record that knew the folder alone"
    assert overlapping(["folder/trip[20:40]"], clips[:1]) == ["folder/trip[20:40]"]
    assert overlapping(clips, ["folder/trip[30:40]", "folder/tri[0:9]"]) == []


@pytest.mark.parametrize("name", ["kitti_odometry/00[a:b]", "kitti_raw/x[1]", "00[nope]"])
def test_names_of_data_sets_have_no_brackets(name: str) -> None:
    with pytest.raises(ConfigError, match="names no frames"):
        FrameRange.parse(name)
