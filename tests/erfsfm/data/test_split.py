"""The split of recordings into training and validation, and split files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from erfsfm.common.errors import DataError
from erfsfm.common.readers.frame_range import overlapping
from erfsfm.config import DataConfig
from erfsfm.data.split import Split, read_split_file, split_recordings


def names(config: DataConfig) -> tuple[list[str], list[str]]:
    training, validation = split_recordings(config)
    return [r.frames_name for r in training], [r.frames_name for r in validation]


@pytest.fixture
def kitti(tmp_path: Path, write_root: Callable[..., Path]) -> Path:
    return write_root(tmp_path / "kitti", frames=6, sequences=("00", "03", "09", "10"), size=(8, 8))


def test_test_sequences_are_never_trained_on(kitti):
    assert names(DataConfig(roots=[kitti])) == (["kitti_odometry/00[0:6]"], [])


def test_a_misspelt_kind_is_not_left_in_the_training(kitti):
    with pytest.raises(DataError, match=r"data\.exclude names 'simulatd/3'"):
        split_recordings(DataConfig(roots=[kitti], exclude=["simulatd/3"]))
    with pytest.raises(DataError, match=r"--camera own\.yaml is for images and videos of your own"):
        split_recordings(DataConfig(roots=[kitti]), Path("own.yaml"))


def test_ranges_and_parts_that_are_excluded(kitti):
    """The frames around such a part train."""
    training, _ = names(DataConfig(roots=[kitti], ranges={"kitti_odometry/00": "1:4"}, exclude=[]))
    assert training[0] == "kitti_odometry/00[1:4]" and len(training) == 4
    held_back = [
        "kitti_raw/2011_10_03_drive_0027[2:4]",
        "kitti_odometry/03",
        "kitti_odometry/09",
        "kitti_odometry/10",
    ]
    config = DataConfig(roots=[kitti], exclude=held_back)
    assert names(config)[0] == ["kitti_odometry/00[0:2]", "kitti_odometry/00[4:6]"]
    config = DataConfig(roots=[kitti], exclude=held_back, ranges={"kitti_odometry/00": "0:3"})
    assert names(config)[0] == ["kitti_odometry/00[0:2]"]


def test_validation_recordings_only_validate(tmp_path, write_root):
    for seed in (499, 500, 599):
        write_root(tmp_path / str(seed), frames=2, seed=seed, size=(8, 8))
    training, validation = names(DataConfig(roots=[tmp_path]))
    assert training == ["simulated/499[0:2]"]
    assert validation == ["simulated/500[0:2]", "simulated/599[0:2]"]


@pytest.fixture
def raw(tmp_path: Path, write_raw: Callable[..., Path]) -> Path:
    """A drive to train on, one of Eigen's scenes, and the drives of the odometry sequences 00 (a scene too) and 09."""
    for drive in (
        "09_26_drive_0001",
        "09_26_drive_0005",
        "09_26_drive_0013",
        "10_03_drive_0027",
        "09_30_drive_0033",
    ):
        write_raw(tmp_path / "raw", drive=f"2011_{drive}", speeds=[9, 9, 9, 0, 9, 9], size=(16, 24))
    return tmp_path / "raw"


def drives(config: DataConfig) -> tuple[set[str], set[str]]:
    training, validation = split_recordings(config)
    return {r.name[-10:] for r in training}, {r.name[-10:] for r in validation}


def test_eigens_scenes_and_test_sequences_are_left_out(raw):
    assert drives(DataConfig(roots=[raw])) == ({"drive_0001", "drive_0005"}, set())
    everything = DataConfig(roots=[raw], exclude=[])
    assert drives(everything)[0] == {
        "drive_0001",
        "drive_0005",
        "drive_0013",
        "drive_0027",
        "drive_0033",
    }
    assert "drive_0033" not in drives(DataConfig(roots=[raw], exclude=["kitti_odometry/09"]))[0]


def test_static_frames_are_left_out(raw, caplog):
    with caplog.at_level("INFO"):
        training, _ = names(
            DataConfig(roots=[raw], exclude=["kitti_raw/2011_09_26_drive_0005", "eigen"])
        )
    assert training[:2] == [
        "kitti_raw/2011_09_26_drive_0001[0:3]",
        "kitti_raw/2011_09_26_drive_0001[4:6]",
    ]
    assert "4 of 24 frames" in caplog.text


def test_the_odometry_split(tmp_path, write_root):
    root = write_root(
        tmp_path, frames=3, sequences=("00", "03", "06", "09", "10", "11"), size=(8, 8)
    )
    training, validation = names(
        DataConfig(roots=[root], split="odometry", validation=[], exclude=[])
    )
    assert training == ["kitti_odometry/00[0:3]", "kitti_odometry/03[0:3]"]
    assert validation == ["kitti_odometry/06[0:3]"]


def test_the_end_of_each_recording_that_is_long_enough_is_kept_to_validate_on(tmp_path, write_root):
    write_root(tmp_path / "long", 50, ("01",), size=(32, 48))
    write_root(tmp_path / "short", 20, ("04",), size=(32, 48))
    config = DataConfig(
        roots=[tmp_path / "long", tmp_path / "short"], validation=[], validation_share=0.4
    )
    training, validation = split_recordings(config)
    assert [each.frames_name for each in training] == [
        "kitti_odometry/01[0:30]",
        "kitti_odometry/04[0:20]",
    ]
    assert [each.frames_name for each in validation] == ["kitti_odometry/01[30:50]"]
    with pytest.raises(
        DataError, match=r"validation_share 0\.4 leaves fewer than 20 frames of .*/04 \(20 frames\)"
    ):
        split_recordings(config.model_copy(update={"roots": [tmp_path / "short"]}))


@pytest.mark.parametrize(("name", "count"), [("eigen", 61), ("odometry", 11)])
def test_nothing_is_in_two_lists(name, count):
    split = read_split_file(name)
    assert split.train and split.validation
    assert overlapping([*split.train, *split.validation], split.test_recordings) == []
    assert overlapping(split.train, split.validation) == []
    everything = [*split.train, *split.validation, *split.test_recordings]
    assert len(set(everything)) == len(everything) == count


@pytest.mark.parametrize(
    ("runs", "frames"),
    [
        ("3", [3]),
        ("0:3", [0, 1, 2]),
        ("0:7:3", [0, 3, 6]),
        ("0:7:3, 9,11:13", [0, 3, 6, 9, 11, 12]),
    ],
)
def test_runs(runs, frames):
    assert Split(test=[f"kitti_raw/a[{runs}]"]).test_frames() == [
        ("kitti_raw/a", frame) for frame in frames
    ]
