"""Names of recordings and frames, also with brackets in them, and whether two share a frame."""

from __future__ import annotations

import pytest

from erfsfm.common.readers.frame_range import EVERYTHING, FrameRange, merge, overlapping
from erfsfm.common.readers.kitti import ODOMETRY_DRIVES


@pytest.mark.parametrize(
    ("name", "recording", "start", "stop"),
    [
        ("folder/br[ack]ets[0:10]", "folder/br[ack]ets", 0, 10),
        ("folder/br[ack]ets", "folder/br[ack]ets", 0, EVERYTHING),
        ("folder/drive[1][5:]", "folder/drive[1]", 5, EVERYTHING),
        ("tum/[desk]", "tum/[desk]", 0, EVERYTHING),
    ],
)
def test_the_range_is_read_from_the_right(name: str, recording: str, start: int, stop: int):
    span = FrameRange.parse(name)
    assert span == FrameRange(recording, start, stop)
    assert FrameRange.parse(str(span)) == span


@pytest.mark.parametrize(
    ("name", "seen", "leaks"),
    [
        ("kitti_odometry/00", "kitti_odometry/01", False),
        ("kitti_odometry/00[0:250]", "kitti_odometry/00[249:300]", True),
        ("kitti_odometry/00[0:250]", "kitti_odometry/00[250:]", False),
        ("kitti_raw/2011_10_03_drive_0027_sync", "kitti_odometry/00[100:200]", True),
        ("kitti_raw/2011_10_03_drive_0027[0:100]", "kitti_odometry/00[100:200]", False),
        ("kitti_raw/2011_09_30_drive_0028[0:1100]", "kitti_odometry/08", False),
        ("kitti_raw/2011_09_30_drive_0028[1100:1101]", "kitti_odometry/08[0:1]", True),
        ("kitti_raw/2011_09_30_drive_0028[1100:1101]", "kitti_odometry/08[1:]", False),
        ("kitti_raw/2011_09_26_drive_0013", "kitti_raw/2011_09_26_drive_0013_sync", True),
        ("simulated/17", "simulated/0-499", True),
        ("simulated/500", "simulated/0-499", False),
        ("simulated/1", "simulated/17", False),
        ("folder/17", "simulated/17", False),
        ("folder/my_drive", "folder/my_drive[0:40]", True),
    ],
)
def test_leaks(name: str, seen: str, leaks: bool):
    assert overlapping([name], [seen]) == ([name] if leaks else [])
    assert overlapping([seen], [name]) == ([seen] if leaks else []), "either way round"


@pytest.mark.parametrize("sequence", sorted(ODOMETRY_DRIVES))
def test_every_odometry_sequence_is_its_raw_drive(sequence: str):
    drive, first, past_last = ODOMETRY_DRIVES[sequence]
    cut, whole = (
        FrameRange.parse(f"kitti_raw/{drive}[{first}:{past_last}]"),
        FrameRange.parse(f"kitti_raw/{drive}"),
    )
    name = f"kitti_odometry/{sequence}"
    assert cut.counted_in(name) == whole.counted_in(name) == FrameRange(name, 0, past_last - first)
    assert FrameRange.parse(name).counted_in(cut.recording) == cut


@pytest.mark.parametrize(
    ("name", "recording", "same"),
    [
        (
            "kitti_raw/2011_09_30_drive_0028[1000:1200]",
            "kitti_odometry/08",
            "kitti_odometry/08[0:100]",
        ),
        (
            "kitti_odometry/08[0:100]",
            "kitti_raw/2011_09_30_drive_0028",
            "kitti_raw/2011_09_30_drive_0028[1100:1200]",
        ),
        (
            "kitti_raw/2011_09_30_drive_0028[5000:]",
            "kitti_odometry/08",
            "kitti_odometry/08[3900:4071]",
        ),
        ("kitti_raw/2011_09_30_drive_0028[0:1100]", "kitti_odometry/08", None),
        ("simulated/500-599[10:]", "simulated/512", "simulated/512[10:]"),
        ("simulated/500-599", "simulated/499", None),
        ("folder/a[3:]", "folder/a", "folder/a[3:]"),
    ],
)
def test_the_same_frames_by_other_numbers(name: str, recording: str, same: str | None):
    found = FrameRange.parse(name).counted_in(recording)
    assert (str(found) if found else None) == same


def test_merge():
    names = [
        "simulated/3",
        "simulated/1",
        "simulated/2",
        "simulated/7",
        "folder/b",
        "folder/a",
        "folder/b",
    ]
    assert merge(names) == ["simulated/1-3", "simulated/7", "folder/a", "folder/b"]
    assert merge([]) == []
