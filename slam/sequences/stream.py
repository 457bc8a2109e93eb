"""Frames of a source as they come: a camera, a stream, a video at its own speed, or a folder being filled."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Condition, Event, Thread
from typing import Any

import cv2
import numpy as np

from erfsfm.common.errors import DataError, without_secrets
from erfsfm.common.readers.camera_file import CameraFile
from erfsfm.common.readers.images import (
    IMAGE_SUFFIXES,
    Stretch,
    first_size,
    is_image,
    natural_key,
    read_image,
    read_values,
    stretch_of,
)
from slam.frames import Frame, Image
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import DEFAULT_FPS, require_size
from slam.sequences.recording import GrowingSequence

logger = logging.getLogger(__name__)

INTERRUPTED, OVER = "it was interrupted", "the source ended"
_LAST_IMAGE_S = 2.0
# an image that waits is dropped for one that was taken later than this: a keyframe takes as long
_MOST_LATE_S = 0.15
_DESCRIBED_STREAMS = (".sdp", ".m3u8")
_POLL_S = 0.01
_RETRY_S = 0.2  # until a stream that is not there is tried again
_WRITING_S = 1.0  # that an image may take to be written


class StreamedSequence(GrowingSequence):
    """The frames that were taken so far of a source, which a thread reads until it ends, dies, or sends nothing.

    Attributes:
        waiting: stamps, images, and when they came.
        arrived_s: when each frame came, by the monotonic clock.
        dropped: number of images that waited, and were too old when another one came.
        ended: why there are no more after those that wait; empty while more may come.
    """

    def __init__(
        self,
        name: str,
        source: Source,
        camera: CameraFile,
        most_wait_s: float,
        every_frame: bool = False,
    ) -> None:
        """``source`` is read from the first frame on until it sends nothing for ``most_wait_s``.

        With ``every_frame`` it waits until each image was taken.

        Args:
            name: of the sequence.
            source: of the images.
            camera: that takes them; where its lens is distorted they are undistorted.
            most_wait_s: after so many seconds without an image the source is over.
            every_frame: whether the source waits for the system; a stored one can.

        Raises:
            SequenceError: the images have another size than the camera, or a live source is asked
                to wait.
        """
        require_size(source, camera, name)
        if every_frame and not source.is_stored:
            raise SequenceError(
                f"{name} does not wait while an image is measured: leave out --every-frame"
            )
        super().__init__(camera, name=name)
        self.arrived_s: list[float] = []
        self.dropped, self.ended = 0, ""
        self._source, self._most_wait_s, self._every_frame = source, most_wait_s, every_frame
        self.waiting: deque[tuple[float, Image, float]] = deque()
        self._changed, self._stopped = Condition(), Event()
        self._thread = Thread(target=self._read, name="reader", daemon=True)

    def frames(self) -> Iterator[Frame]:
        """Every frame as it is taken."""
        self._thread.start()
        while (taken := self._take()) is not None:
            index, (stamp, image, at_s) = len(self), taken
            image = image if self.undistortion is None else self.undistortion.apply(image)
            image.setflags(write=False)
            self.stamps = np.append(self.stamps, stamp)
            self.arrived_s.append(at_s)
            yield Frame(index, stamp, image, self.fixed)

    def stop(self) -> None:
        """End after the images that wait."""
        self._stopped.set()
        self._end(INTERRUPTED)

    def close(self) -> None:
        """Stop, and wait for the thread: one that still decodes an image when the process ends would abort it."""
        self.stop()
        if self._thread.is_alive():
            self._thread.join(_LAST_IMAGE_S)

    def _take(self) -> tuple[float, Image, float] | None:
        with self._changed:
            self._changed.wait_for(lambda: self.waiting or self.ended, self._most_wait_s)
            taken = self.waiting.popleft() if self.waiting else None
            self._changed.notify()
            if taken is None:
                self.ended = self.ended or f"nothing came for {self._most_wait_s:g} s"
                self._stopped.set()
            return taken

    def _read(self) -> None:
        try:
            for stamp, image in self._source.images(self._stopped):
                with self._changed:
                    if self._every_frame:
                        self._changed.wait_for(lambda: not self.waiting or self._stopped.is_set())
                    if self._stopped.is_set():
                        return
                    while self.waiting and stamp - self.waiting[0][0] > _MOST_LATE_S:
                        self.waiting.popleft()
                        self.dropped += 1
                    self.waiting.append((stamp, image, time.monotonic()))
                    self._changed.notify()
            self._end(OVER)
        except SequenceError as error:
            self._end(f"the source died: {error}")

    def _end(self, reason: str) -> None:
        with self._changed:
            self.ended = self.ended or reason
            self._changed.notify()


class FolderSource:
    """A folder that another program fills; image ``k`` in natural order was taken at ``k / fps``."""

    is_stored = True

    def __init__(self, folder: Path, wait_s: float) -> None:
        """Wait up to ``wait_s`` for the first image that can be read; it gives the size.

        Args:
            folder: that is filled.
            wait_s: for the first image, seconds.

        Raises:
            SequenceError: no image came in time, or the folder cannot be read.
        """
        self._folder, self.fps = folder, DEFAULT_FPS
        self._past: set[str] = set()
        self._stretch: Stretch | None = None
        deadline = time.monotonic() + wait_s
        while (size := self._first_size()) is None:
            if time.monotonic() > deadline:
                suffixes = ", ".join(IMAGE_SUFFIXES)
                raise SequenceError(
                    f"no image came to {folder} within {wait_s:g} s: looked for {suffixes}"
                )
            time.sleep(_POLL_S)
        self.height, self.width = size

    def images(self, stopped: Event) -> Iterator[tuple[float, Image]]:
        """Every usable image, in natural order; one that comes after its successor is left out with a warning."""
        count, last = 0, Path()
        while not stopped.is_set():
            waiting = self._waiting()
            for path in waiting:
                if stopped.is_set():
                    return
                if natural_key(path) < natural_key(last):
                    logger.warning(
                        "%s came after %s, before which its name belongs; it is left out",
                        path,
                        last.name,
                    )
                else:
                    image = self._usable(path)
                    if image is not None:
                        yield count / self.fps, image
                    count, last = count + 1, path
                self._past.add(path.name)
            if not waiting:
                time.sleep(_POLL_S)

    def _usable(self, path: Path) -> Image | None:
        """An image of the size of the first; others are named in a warning.

        One that is still being written is read again for a second, or until the next one is there.
        """
        deadline, is_written = time.monotonic() + _WRITING_S, False
        while True:
            try:
                image = read_image(path, self._stretch)
                break
            except DataError as error:
                if time.monotonic() > deadline or is_written:
                    logger.warning("%s; it is left out", error)
                    return None
                is_written = self._waiting()[-1:] != [path]
                time.sleep(_POLL_S)
        height, width = image.shape[:2]
        if (height, width) == (self.height, self.width):
            return image
        logger.warning(
            "%s is %d x %d, not %d x %d; it is left out",
            path,
            width,
            height,
            self.width,
            self.height,
        )
        return None

    def _waiting(self) -> list[Path]:
        """Images that were not read yet, in natural order."""
        try:
            fresh = [path for path in self._folder.iterdir() if path.name not in self._past]
        except OSError as error:
            raise SequenceError(
                f"{self._folder} cannot be read any more: {error.strerror or error}"
            ) from error
        return sorted(filter(is_image, fresh), key=natural_key)

    def _first_size(self) -> tuple[int, int] | None:
        """Height and width of the first image that can be read; None while there is none."""
        with suppress(DataError):  # it is still being written
            if waiting := self._waiting():
                self._stretch = stretch_of(waiting, read_values)
                return first_size(waiting)
        return None


class VideoSource:
    """A source that OpenCV opens: a camera's number, a stream's address, or a file, played at its own speed."""

    def __init__(self, name: str, wait_s: float) -> None:
        """Open it; a stream or a camera within ``wait_s``, and again within ``wait_s`` where it breaks off.

        Args:
            name: a camera's number, a stream's address, or a file.
            wait_s: for the first image, and where it breaks off, seconds.

        Raises:
            SequenceError: it is a pipe, or no image comes.
        """
        self._address, self._name, self._wait_s = name, without_secrets(name), wait_s
        self.is_stored = (
            Path(name).is_file() and Path(name).suffix.lower() not in _DESCRIBED_STREAMS
        )
        if Path(name).is_fifo():  # OpenCV would wait for ever
            raise SequenceError(
                f"{name} is a pipe: let the camera fill a folder, or give the address of its stream"
            )
        self._first = self._opened(Event())
        if self._first is None:
            raise SequenceError(
                f"no image comes from {name}: check the camera, the address or the file"
            )
        self.fps = float(self.is_stored and self._capture.get(cv2.CAP_PROP_FPS)) or DEFAULT_FPS
        self.height, self.width = self._first.shape[:2]

    def images(self, stopped: Event) -> Iterator[tuple[float, Image]]:
        """Images at their time: in a file that of its frame rate, elsewhere that of their arrival."""
        began, count, image = time.monotonic(), 0, self._first
        while image is not None and not stopped.is_set():
            stamp = count / self.fps if self.is_stored else time.monotonic() - began
            if self.is_stored and stopped.wait(max(began + stamp - time.monotonic(), 0.0)):
                break
            if image.shape[:2] == (self.height, self.width):
                yield stamp, image
            count, image = count + 1, self._next()
            if (
                image is None
                and not self.is_stored
                and self._capture.get(cv2.CAP_PROP_FRAME_COUNT) <= 0
            ):
                logger.warning(
                    "%s broke off after %d images: it is opened again", self._name, count
                )
                image = self._opened(stopped)
        self._capture.release()

    def _opened(self, stopped: Event) -> Image | None:
        """The first image; None where none comes in time."""
        name = self._address
        is_patient = not self.is_stored and (
            name.isdecimal() or "://" in name or Path(name).exists()
        )
        deadline = time.monotonic() + (self._wait_s if is_patient else 0.0)
        while True:
            self._capture: Any = cv2.VideoCapture(int(name) if name.isdecimal() else name)
            image = self._next()
            if image is not None or time.monotonic() > deadline or stopped.wait(_RETRY_S):
                return image
            self._capture.release()

    def _next(self) -> Image | None:
        read, image = self._capture.read()
        return np.ascontiguousarray(image[..., ::-1]) if read and image is not None else None


Source = FolderSource | VideoSource
"""Images as they come, each with its stamp in seconds; ``is_stored`` where they wait to be read."""


def open_source(camera: str, wait_s: float) -> Source:
    """A source by what the user named; its ``fps``, of files, may be set before the first image."""
    folder = Path(camera)
    return FolderSource(folder, wait_s) if folder.is_dir() else VideoSource(camera, wait_s)
