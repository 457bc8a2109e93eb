"""Sources that stall or die or are too fast: a folder, a video at its own speed, a stream, a camera that breaks off."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Event, Thread

import cv2
import numpy as np
import pytest

from slam.frames import Image
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import explicit_camera
from slam.sequences.stream import FolderSource, StreamedSequence, VideoSource, open_source


class Scripted:
    """A source of small images that calls ``before`` with the number of each, and may die after the last one."""

    width, height, fps, is_stored = 8, 8, 10.0, False

    def __init__(self, images: int, before: Callable[[int], object], dies: bool = False) -> None:
        self._images, self._before, self._dies, self.is_over = images, before, dies, Event()

    def images(self, stopped: Event) -> Iterator[tuple[float, Image]]:
        for number in range(self._images):
            self._before(number)
            yield 0.1 * number, np.full((8, 8, 3), number, np.uint8)
        self.is_over.set()
        if self._dies:
            raise SequenceError("the cable was pulled")


def streamed(source: Scripted, wait_s: float = 60.0, every_frame: bool = False) -> StreamedSequence:
    camera = explicit_camera(Path("fov=70"), source)
    return StreamedSequence("scripted", source, camera, wait_s, every_frame)


def test_a_source_that_is_faster_than_we_are_is_dropped_from():
    """While we are busy with the first of 51 images, all others come; the last two of them wait."""
    first_is_taken = Event()
    source = Scripted(51, lambda number: number and first_is_taken.wait())
    sequence, taken = streamed(source), []
    for frame in sequence.frames():
        taken.append(int(frame.image[0, 0, 0]))
        first_is_taken.set()
        source.is_over.wait()
    assert taken == [0, 49, 50] and sequence.dropped == 48 and sequence.ended == "the source ended"


def test_with_every_frame_a_source_waits_until_its_image_was_taken():
    source = Scripted(20, lambda number: None)
    source.is_stored = True
    sequence, taken = streamed(source, every_frame=True), []
    for frame in sequence.frames():
        taken.append(int(frame.image[0, 0, 0]))
        time.sleep(0.001)
    assert (
        taken == list(range(20)) and sequence.dropped == 0 and sequence.ended == "the source ended"
    )


def test_a_source_that_stalls_and_one_that_dies_say_so():
    released = Event()
    stalls = streamed(Scripted(2, lambda number: number and released.wait()), 0.2)
    assert len(list(stalls.frames())) == 1 and stalls.ended == "nothing came for 0.2 s"
    released.set()
    first_is_taken = Event()
    dies = streamed(Scripted(2, lambda number: number and first_is_taken.wait(), dies=True))
    assert (
        len([first_is_taken.set() for _ in dies.frames()]) == 2
        and dies.ended == "the source died: the cable was pulled"
    )


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Eight images, each brighter by 30 than the one before, at 20 Hz."""
    path = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (32, 24))
    for number in range(8):
        writer.write(np.full((24, 32, 3), 30 * number, np.uint8))
    writer.release()
    return path


@contextmanager
def served(video: Path) -> Iterator[str]:
    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(
        ("127.0.0.1", 0), partial(Quiet, directory=str(video.parent))
    ) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/{video.name}"
        server.shutdown()


def test_an_address_gives_images_as_they_arrive(video: Path):
    with served(video) as name:
        stamps, images = zip(*open_source(name, 5.0).images(Event()), strict=True)
    assert [round(float(image.mean()) / 30) for image in images] == list(range(8))
    assert stamps[0] >= 0 and (np.diff(stamps) > 0).all()
    assert stamps[-1] < 1e6, "seconds since the first, not since 1970"


class Camera(BaseHTTPRequestHandler):
    """Motion JPEG: six images a connection, each as bright as its number."""

    sent = 0

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=image")
        self.end_headers()
        for _ in range(6):
            _, jpeg = cv2.imencode(".jpg", np.full((24, 32, 3), 20 * Camera.sent, np.uint8))
            head = f"--image\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            self.wfile.write(head.encode() + jpeg.tobytes() + b"\r\n")
            Camera.sent += 1

    def log_message(self, *_: object) -> None:
        pass


def test_a_camera_that_comes_late_and_breaks_off_is_opened_again():
    with ThreadingHTTPServer(("127.0.0.1", 0), Camera) as found:
        address = found.server_address
    server = ThreadingHTTPServer(address, Camera, bind_and_activate=False)

    def come() -> None:
        time.sleep(0.5)
        server.server_bind()
        server.server_activate()
        server.serve_forever()

    Thread(target=come, daemon=True).start()
    stopped = Event()
    seen = []
    for _, image in open_source(f"http://127.0.0.1:{address[1]}/live", 20.0).images(stopped):
        seen.append(round(float(image.mean()) / 20))
        if max(seen) >= 8:
            stopped.set()
    server.shutdown()
    server.server_close()
    assert seen == sorted(seen) and seen[0] == 0 and len(set(seen)) >= 5


def test_a_video_plays_at_its_own_speed(video: Path):
    source = VideoSource(str(video), 0.1)
    assert source.fps == 20.0
    stamps = [stamp for stamp, _ in source.images(Event())]
    np.testing.assert_allclose(stamps, np.arange(8) / 20.0)
    assert (source.width, source.height) == (32, 24)


def test_a_folder_is_read_in_natural_order(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """Numbers without zeros in front; hidden files are no images, and one that comes too late is named."""

    def take(number: int) -> None:
        cv2.imwrite(str(tmp_path / f"frame_{number}.png"), np.full((20, 30, 3), number, np.uint8))

    (tmp_path / "._frame_0.png").write_bytes(b"of another system")
    take(8)
    images = (int(image[0, 0, 0]) for _, image in FolderSource(tmp_path, 0.1).images(Event()))
    assert next(images) == 8
    for number in (10, 7, 9):
        take(number)
    assert [next(images), next(images)] == [9, 10]
    assert (
        "frame_7.png came after frame_8.png, before which its name belongs; it is left out"
        in caplog.text
    )


def test_a_broken_first_image_is_left_out(kitti_root: Path, tmp_path: Path):
    (tmp_path / "000000.png").write_bytes(b"damaged")
    shutil.copy(kitti_root / "sequences" / "sim" / "image_2" / "000001.png", tmp_path)
    source, stopped = FolderSource(tmp_path, 5.0), Event()
    for stamp, image in source.images(stopped):
        assert (stamp, image.shape) == (0.1, (source.height, source.width, 3))
        stopped.set()


def test_sources_that_are_not_there(tmp_path: Path):
    with pytest.raises(SequenceError, match="no image comes from"):
        VideoSource(str(tmp_path / "none.mp4"), 0.1)
    with pytest.raises(SequenceError, match="no image comes from 99: check the camera"):
        open_source("99", 0.1)
    with pytest.raises(SequenceError, match=r"no image came to .* within 0\.1 s"):
        FolderSource(tmp_path, 0.1)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(SequenceError, match="pipe is a pipe"):
        open_source(str(tmp_path / "pipe"), 0.1)
