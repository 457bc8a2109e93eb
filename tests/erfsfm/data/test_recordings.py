"""Videos: frames read in any order, and the errors of damaged files."""

from __future__ import annotations

import json
import logging
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest

from erfsfm.common.errors import TrainingError
from erfsfm.common.readers.images import read_image
from erfsfm.common.readers.video import VideoFrames
from erfsfm.data import many_view_teacher
from erfsfm.data import recordings as module
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.data.recordings import Recording, Video
from erfsfm.geometry import Camera

FRAMES, SIZE = 40, (48, 32)


def write(path: Path, frames: int = FRAMES, codec: str = "mp4v") -> Path:
    """Frame k is painted 5 k, and a bar of its own makes each depend on the one before in the codec's eyes."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 10, SIZE)
    for index in range(frames):
        image = np.full((SIZE[1], SIZE[0], 3), 5 * index, np.uint8)
        image[:, index % SIZE[0]] = 255
        writer.write(image)
    writer.release()
    return path


def number(image: np.ndarray) -> int:
    return round((float(np.median(image)) + 2) / 5)  # codecs darken by up to 3 levels


@pytest.mark.parametrize(
    ("suffix", "codec"), [(".mp4", "mp4v"), (".avi", "MJPG"), (".mkv", "mp4v")]
)
def test_frames_in_any_order(tmp_path, suffix, codec):
    video = Video(write(tmp_path / f"a{suffix}", codec=codec))
    assert (len(video), video.width, video.height) == (FRAMES, *SIZE)
    order = [0, 39, 7, 8, 30, 2, 39, 7]
    assert [number(video.image(index, 32, 48)) for index in order] == order


def test_the_file_is_decoded_once_a_size(tmp_path, monkeypatch):
    video = Video(write(tmp_path / "a.mp4"))
    opened: list[Path] = []

    class Counted(VideoFrames):
        def __init__(self, path: Path, counted_frames: int) -> None:
            opened.append(path)
            super().__init__(path, counted_frames)

    monkeypatch.setattr(module, "VideoFrames", Counted)
    small = [video.image(index, 16, 24) for index in (9, 3, 9)]
    assert len(opened) == 1
    assert small[0].shape == (16, 24, 3)
    assert video.image(9, 32, 48).shape == (32, 48, 3)
    sent = pickle.dumps(video)
    assert len(sent) < 1000, "without its frames"
    assert number(pickle.loads(sent).image(9, 32, 48)) == 9
    assert len(opened) == 2


def test_the_teacher_gets_the_frames_of_a_part_as_images(tmp_path, monkeypatch):
    video = Video(write(tmp_path / "a.mp4"))
    whole = Recording(
        "folder/a", (video.path,) * len(video), Camera(48, 32, 40.0, 40.0, 23.5, 15.5), video
    )
    numbers: list[int] = []

    def slam(words: list[str]) -> str:
        images, output = (
            Path(words[words.index(option) + 1]) for option in ("--dataset", "--output")
        )
        numbers.extend(number(read_image(path)) for path in sorted(images.glob("*.png")))
        output.mkdir()
        np.savetxt(
            output / "trajectory_optimised.kitti.txt",
            np.tile(np.eye(4)[:3].ravel(), (len(numbers), 1)),
        )
        unit = "metres" if len(numbers) == 4 else "the networks' own unit"
        (output / "metrics.json").write_text(json.dumps({"scale": {"unit": unit}}))
        return ""

    monkeypatch.setattr(many_view_teacher, "slam_process", slam)
    teacher = ManyViewTeacher(tmp_path / "measured", (16, 24), stride=2, with_depth=False)
    teacher.prepare([whole.part(20, 24)], 2, "sim", lambda *_: None)
    assert numbers == [20, 21, 22, 23]
    with pytest.raises(TrainingError, match="no road was found"):
        teacher.prepare([whole.part(30, 33)], 2, "sim", lambda *_: None)


def test_a_video_that_was_cut_off(tmp_path, caplog):
    """An avi keeps its count of frames in front: half the file has half of them, and a warning is logged."""
    path = write(tmp_path / "a.avi", codec="MJPG")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with caplog.at_level(logging.WARNING):
        video = Video(path)
    assert 5 <= len(video) <= 30
    assert f"announces {FRAMES} frames and has {len(video)}: it may be cut off" in caplog.text
    assert number(video.image(len(video) - 2, 32, 48)) == len(video) - 2
