"""The index of a pack, as a data set."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from erfsfm.common.errors import DataError
from erfsfm.data.discovery import discover
from erfsfm.data.pack_index import (
    INDEX_FILE,
    PackedCamera,
    PackedRecording,
    PackIndex,
    depth_file,
    image_file,
    poses_file,
    write_index,
)
from erfsfm.data.shards import ShardIndex

CAMERA = PackedCamera(width=64, height=32, fx=40, fy=41, cx=31, cy=15)


@pytest.fixture
def packed(tmp_path: Path) -> Path:
    """Frames 7 to 9 of a sequence, with true poses, and true depth of the one in the middle."""
    tmp_path = tmp_path / "pack"
    for number in (7, 8, 9):
        path = image_file(tmp_path, "0000", number)
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.full((32, 64, 3), 20 * number, np.uint8))
    depth = depth_file(tmp_path, "0000", 8)
    depth.parent.mkdir(parents=True)
    cv2.imwrite(str(depth), np.full((32, 64), 512, np.uint16))
    poses = poses_file(tmp_path, "0000")
    poses.parent.mkdir()
    poses.write_text("".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(3)))
    entry = PackedRecording(
        name="kitti_odometry/00", start=7, frames=3, folder="0000", camera=CAMERA, poses=True, depth=[8]
    )
    shards = ShardIndex(files=1, most_bytes=1000, sources=2, stride=1)
    write_index(tmp_path, PackIndex(recordings=[entry], shards=shards, sharded=[]))
    return tmp_path


def test_frames_keep_their_name_numbers_camera_and_truth(packed: Path) -> None:
    (recording,) = discover(packed)
    assert recording.frames_name == "kitti_odometry/00[7:10]"
    assert recording.camera.fy == 41
    assert abs(int(recording.image(2, 32, 64).mean()) - 180) <= 1
    assert recording.true_depth(0) is None
    truth, poses = recording.true_depth(1), recording.part(1, 3).true_poses()
    assert truth is not None and (truth == 2).all()
    assert poses is not None and poses[:, 0, 3].tolist() == [1, 2]


def test_a_pack_beside_other_data_is_found(packed: Path) -> None:
    assert [r.name for r in discover(packed.parent)] == ["kitti_odometry/00"]


@pytest.mark.parametrize("lost", [image_file(Path(), "0000", 8), poses_file(Path(), "0000")], ids=["image", "poses"])
def test_a_missing_file_is_one_line(packed: Path, lost: Path) -> None:
    (packed / lost).unlink()
    with pytest.raises(DataError, match=rf"{lost.name} is missing: copy the pack again"):
        discover(packed)


@pytest.mark.parametrize(
    "text, problem",
    [("recordings: 3", "recordings: Input should be a valid list"), ("recordings: [", "is not YAML"), ("", "damaged")],
)
def test_a_damaged_index_is_one_line(packed: Path, text: str, problem: str) -> None:
    (packed / INDEX_FILE).write_text(text)
    with pytest.raises(DataError, match=problem) as caught:
        discover(packed)
    assert "\n" not in str(caught.value)


def test_more_frames_than_there_can_be_take_no_memory(packed: Path) -> None:
    text = (packed / INDEX_FILE).read_text()
    (packed / INDEX_FILE).write_text(re.sub(r"frames: \d+", "frames: 1600000000", text))
    with pytest.raises(DataError, match="frames: Input should be less than or equal to 1000000"):
        discover(packed)


def test_a_folder_outside_the_pack_is_refused(packed: Path) -> None:
    text = (packed / INDEX_FILE).read_text()
    (packed / INDEX_FILE).write_text(text.replace("folder: '0000'", "folder: ../0000"))
    with pytest.raises(DataError, match=r"recordings\.0\.folder"):
        discover(packed)
