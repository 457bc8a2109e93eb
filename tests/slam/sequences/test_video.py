import struct
from fractions import Fraction
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from erfsfm.common.readers.video import VideoFrames
from slam.sequences import loader
from slam.sequences.catalogue import open_sequence


def write_video(path: Path) -> Path:
    """Ninety black frames but for number 12, which is white."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for k in range(90):
        writer.write(np.full((48, 64, 3), 255 * (k == 12), np.uint8))
    writer.release()
    return path


@pytest.fixture
def camera_64(camera_yaml: str) -> str:
    return camera_yaml.replace("width: 40", "width: 64").replace("height: 24", "height: 48")


@pytest.mark.parametrize("by_folder", [False, True])
def test_opens(tmp_path: Path, camera_64: str, by_folder: bool) -> None:
    path = write_video(tmp_path / "trip" / "drive.avi")
    (tmp_path / "trip" / "camera.yaml").write_text(camera_64)
    (tmp_path / "trip" / "._drive.avi").write_bytes(b"what macOS keeps beside a file")
    sequence = open_sequence(tmp_path / "trip" if by_folder else path, None, None, "10:20")
    assert (sequence.name, len(sequence)) == ("drive", 10)
    assert [bool(sequence.frame(k).image.mean() > 200) for k in range(1, 4)] == [False, True, False]
    assert sequence.stamps[0] == pytest.approx(2.0)
    assert sequence.provenance() == ("folder/trip[10:20]",)


def write_mp4(path: Path, times: list[int], rate: int = 30, rotated: bool = False) -> Path:
    """Grey frames of 64x48 shown at ``times``, in units of 1/600 s; the left half of each is white."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate, options={"bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 600)
        for time in times:
            picture = np.full((48, 64, 3), 90, np.uint8)
            picture[:, :32] = 255
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 600)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    if rotated:
        turned = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 48 << 16, 0, 1 << 30)
        straight = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
        data = path.read_bytes()
        header = data.index(b"tkhd")
        assert straight in data[header:]
        path.write_bytes(data[:header] + data[header:].replace(straight, turned, 1))
    return path


UNEVEN = [0, 20, 40, 100, 120, 140, 160, 220, 240, 260]


def test_uneven_frame_times_are_used(tmp_path: Path, camera_64: str, caplog: pytest.LogCaptureFixture) -> None:
    path = write_mp4(tmp_path / "phone.mp4", UNEVEN)
    camera = tmp_path / "camera.yaml"
    camera.write_text(camera_64.replace("fps: 5", "fps: 20"))
    assert open_sequence(path).stamps == pytest.approx(np.array(UNEVEN) / 600)
    camera.write_text(camera_64)
    assert open_sequence(path).stamps == pytest.approx(np.arange(10) / 5)
    assert "has 20.77 frames a second, the camera has 5: taken as even at the camera's rate" in caplog.text


def test_missing_frames_do_not_change_the_rate(tmp_path: Path, camera_64: str) -> None:
    times = [60 * k for k in range(60) if k % 7 and not 30 <= k < 35]
    path = write_mp4(tmp_path / "drive.mp4", times)
    (tmp_path / "camera.yaml").write_text(camera_64.replace("fps: 5", "fps: 10"))
    assert open_sequence(path).stamps == pytest.approx((np.array(times) - times[0]) / 600)


def test_even_frames_have_the_rate_of_the_video(
    tmp_path: Path, camera_64: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_mp4(tmp_path / "phone.mp4", [120 * k for k in range(12)])
    camera = tmp_path / "camera.yaml"
    for fps, stamps in (("5.02", np.arange(12) / 5.02), ("5.4", np.arange(12) / 5), ("10", np.arange(12) / 10)):
        assert "frames a second" not in caplog.text
        camera.write_text(camera_64.replace("fps: 5", f"fps: {fps}"))
        assert open_sequence(path).stamps == pytest.approx(stamps, abs=1e-9), fps
    assert "phone.mp4 has 5 frames a second, the camera has 10: taken as even at the camera's rate" in caplog.text


def test_a_field_of_view_takes_the_rate_of_the_video(tmp_path: Path) -> None:
    path = write_mp4(tmp_path / "phone.mp4", [24 * k for k in range(8)])
    sequence = open_sequence(path, camera=Path("fov=90"))
    assert sequence.intrinsics.fx == pytest.approx(32)
    assert sequence.stamps == pytest.approx(np.arange(8) / 25)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_frames_and_times_of_a_long_video_are_those_of_its_packets(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """An mkv announces a guess: its duration times a rate."""
    path = write_mp4(tmp_path / f"long{suffix}", UNEVEN)
    monkeypatch.setattr(loader, "VideoFrames", partial(VideoFrames, counted_frames=4))
    sequence = open_sequence(path, camera=Path("fov=70"))
    assert sequence.stamps == pytest.approx(np.array(UNEVEN) / 600, abs=5e-4)
    assert ("announces 14 frames and has 10" in caplog.text) == (suffix == ".mkv")


def test_a_rotation_flag_turns_the_images(tmp_path: Path) -> None:
    """A phone held upright stores lying images and a flag: 90 degrees, so that left becomes top."""
    path = write_mp4(tmp_path / "upright.mp4", [20 * k for k in range(4)], rotated=True)
    sequence = open_sequence(path, camera=Path("fov=60"))
    assert (sequence.intrinsics.width, sequence.intrinsics.height) == (48, 64)
    image = sequence.frame(2).image
    assert image[:28].mean() > 200 and image[36:].mean() < 130
