"""Frames of a video, decoded in order once and kept at the size that the networks want."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.data.images import resize_image
from erfsfm.errors import DataError

logger = logging.getLogger(__name__)

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv")


class Video:
    """A video file with random access.

    A seek in compressed video may land beside the frame asked for. Hence the first frame asked for decodes the file
    from its beginning to its end, and all of it is kept, shrunken, in a temporary file that the system pages in and
    out: 160 kB a frame at 416x128. Each process that asks keeps its own.
    """

    def __init__(self, path: Path) -> None:
        """Count the frames, which takes one pass: what the file announces may be wrong.

        Raises:
            DataError: the file cannot be decoded.
        """
        self.path = path
        capture = _open(path)
        announced = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self._length = 0
        while capture.grab():
            self._length += 1
        capture.release()
        if self._length == 0:
            raise DataError(f"{path} has no frame that can be decoded: convert it to H.264 in mp4, or copy it again")
        if 0 < announced != self._length:
            logger.warning("%s announces %d frames and has %d: it may be cut off", path, announced, self._length)
        first = next(self._decoded())
        self.height, self.width = first.shape[:2]
        self._frames: NDArray[np.uint8] | None = None

    def __len__(self) -> int:
        return self._length

    def image(self, index: int, height: int, width: int) -> NDArray[np.uint8]:
        """One frame ``(height, width, 3)`` uint8 BGR, resized without crop.

        Raises:
            DataError: the file breaks off or is damaged before its end.
        """
        if self._frames is None or self._frames.shape[1:3] != (height, width):
            self._frames = self._keep(height, width)
        return np.array(self._frames[index])

    def _keep(self, height: int, width: int) -> NDArray[np.uint8]:
        with tempfile.TemporaryFile(prefix="erfsfm-video-") as file:
            for image in self._decoded():
                file.write(resize_image(image, height, width).tobytes())
            file.flush()
            return np.memmap(file, np.uint8, "r", shape=(self._length, height, width, 3))

    def _decoded(self) -> Iterator[NDArray[np.uint8]]:
        """All frames as stored."""
        capture = _open(self.path)
        for index in range(self._length):
            readable, image = capture.read()
            if not readable:
                raise DataError(
                    f"frame {index} of {self.path} cannot be decoded: copy the video again, or cut it there"
                )
            yield np.asarray(image, dtype=np.uint8)
        capture.release()


def _open(path: Path) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise DataError(f"{path} cannot be read as a video: it is damaged or of an unknown format; copy it again")
    return capture
