"""Frames of a video, decoded in order once and kept at the networks' input size."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from erfsfm.common.readers.images import Image, resize_image
from erfsfm.common.readers.video import VideoFrames

_kept: dict[Path, Image] = {}  # of this process: the frames ``(N, height, width, 3)`` of each video at one size


class Video:
    """A video file with random access to downscaled frames.

    Training reads frames in any order, and a seek in compressed video is slow. Hence the first access decodes the file
    from its beginning to its end, and all frames are kept, downscaled, in a temporary file that the system pages in and
    out: 160 kB a frame at 416x128. Each process has its own, which a video that is sent to it does not carry.
    """

    def __init__(self, path: Path) -> None:
        """Count the frames, which takes one pass: what the file announces may be wrong.

        Raises:
            DataError: the file cannot be decoded.
        """
        self.path = path
        frames = VideoFrames(path, counted_frames=sys.maxsize)
        self._length = len(frames)
        self.height, self.width = frames.height, frames.width
        _kept.pop(path, None)  # of a file that lay there before

    def __len__(self) -> int:
        return self._length

    def image(self, index: int, height: int, width: int) -> Image:
        """One frame ``(height, width, 3)`` uint8 RGB, resized without crop.

        Raises:
            DataError: the file breaks off or is damaged before its end.
        """
        frames = _kept.get(self.path)
        if frames is None or frames.shape[1:3] != (height, width):
            frames = _kept[self.path] = self._keep(height, width)
        return np.array(frames[index])

    def _keep(self, height: int, width: int) -> Image:
        frames = VideoFrames(self.path, counted_frames=0)
        with tempfile.TemporaryFile(prefix="erfsfm-video-") as file:
            for index in range(self._length):
                file.write(resize_image(frames.read(index), height, width).tobytes())
            file.flush()
            return np.memmap(file, np.uint8, "r", shape=(self._length, height, width, 3))
