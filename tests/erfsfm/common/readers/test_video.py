"""The frames of a video, in any order."""

from __future__ import annotations

import subprocess
import sys
import weakref
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from erfsfm.common.readers.video import VideoFrames

FRAMES = 90
FORMATS = {".mp4": "mp4v", ".avi": "MJPG", ".mov": "mp4v", ".mkv": "MJPG"}


def coded(number: int) -> np.ndarray:
    """An image whose eight upright stripes are the bits of a number."""
    bits = np.array([255 * (number >> bit & 1) for bit in range(8)], np.uint8)
    return np.repeat(np.tile(np.repeat(bits, 8), (48, 1))[..., None], 3, axis=2)


def decoded(image: np.ndarray) -> int:
    bright = image[:, 4::8].mean(axis=(0, 2)) > 127
    return int(sum(1 << bit for bit in range(8) if bright[bit]))


def write_video(path: Path, frames: int = FRAMES) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    fourcc = cv2.VideoWriter.fourcc(*FORMATS[path.suffix])
    writer = cv2.VideoWriter(str(path), fourcc, 10, (64, 48))
    if not writer.isOpened():
        pytest.skip(f"this OpenCV cannot write {path.suffix}")
    for k in range(frames):
        writer.write(coded(k))
    writer.release()
    return path


@pytest.mark.parametrize(
    ("suffix", "counted_frames"), [*((suffix, 3000) for suffix in FORMATS), (".avi", 10)]
)
def test_any_order_gives_the_right_frame(tmp_path: Path, suffix: str, counted_frames: int):
    """Also of a long one, whose frames are not counted."""
    frames = VideoFrames(write_video(tmp_path / f"a{suffix}"), counted_frames)
    assert (len(frames), frames.width, frames.height) == (FRAMES, 64, 48)
    for index in [0, 1, 2, 80, 3, 79, 89, 10, 11, 0, 45]:
        assert decoded(frames.read(index)) == index


def test_a_video_is_closed_as_soon_as_nobody_reads_it(tmp_path: Path):
    """Left to the garbage collector it might be closed in a forked data loader, which would hang."""
    frames = VideoFrames(write_video(tmp_path / "a.avi"))
    kept = weakref.ref(frames)
    del frames
    assert kept() is None


def test_a_name_with_colons_is_no_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "drive.mp4").rename("12:30:05.mp4")
    frames = VideoFrames(Path("12:30:05.mp4"))
    assert len(frames) == FRAMES and decoded(frames.read(3)) == 3


def test_an_uncounted_video_is_decoded_once_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    called, opened = [], cv2.VideoCapture

    class Watched:
        """A subclass of OpenCV's own would crash."""

        def __init__(self, path: str) -> None:
            self._capture = opened(path)

        def __getattr__(self, name: str) -> Any:
            called.append(name)
            return getattr(self._capture, name)

    path = write_video(tmp_path / "a.avi")
    monkeypatch.setattr(cv2, "VideoCapture", Watched)
    frames = VideoFrames(path, counted_frames=10)
    wanted = range(0, FRAMES, 40)
    assert [decoded(frames.read(index)) for index in wanted] == list(wanted)
    assert called.count("grab") == wanted[-1] + 1


def test_a_damaged_video_is_one_line_in_a_process_of_its_own(tmp_path: Path):
    """The decoder would print lines of its own past Python."""
    path = tmp_path / "a.mp4"
    path.write_bytes(write_video(tmp_path / "b.mp4").read_bytes()[:600])
    code = (
        "import sys\nfrom pathlib import Path\nfrom erfsfm.common.errors import DataError\n"
        "from erfsfm.common.readers.video import VideoFrames\n"
        "try:\n    VideoFrames(Path(sys.argv[1]))\nexcept DataError as error:\n    print(error, file=sys.stderr)"
    )
    answer = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True
    )
    (line,) = answer.stderr.splitlines()
    assert "a.mp4 cannot be opened: copy it again" in line
