"""The frames of a video file: decoded in order, with exact access to any of them."""

from __future__ import annotations

import functools
import importlib
import logging
import os
import weakref
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.readers.images import Image, recording_folder

logger = logging.getLogger(__name__)

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv")
_COUNTED_FRAMES = 3000
_CACHED_FRAMES = 32
_SKIPPED_FRAMES = 30
_QUIET = "-8"  # AV_LOG_QUIET


class VideoFrames:
    """The frames of a video, in any order.

    A seek in compressed video may land on another frame, so its time is checked against the time recorded
    for the wanted frame; where they differ, the video is decoded again from its start. The last
    frames stay in memory. Not for use from several threads.

    One pass over the file tells how many frames there are and when each is shown: it is decoded, or, where it is long,
    its packets are read by PyAV, an optional extra. Without PyAV a long video has the frames that it announces.

    Attributes:
        fps: frames a second by their times, else as announced; None where the file does not say.
        pixel_aspect: width of a pixel over its height.
    """

    def __init__(self, path: Path, counted_frames: int = _COUNTED_FRAMES) -> None:
        """Open a video; one that announces more than ``counted_frames`` is long.

        Raises:
            DataError: the video cannot be opened, or has no frame.
        """
        self._path = path
        self._next = 0
        self._times_ms: list[float] = []
        self._capture = _capture(path)
        announced = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if announced > counted_frames:
            shown_s = _packet_times(path)
        else:
            while self._grab():
                pass
            shown_s = np.array(self._times_ms) / 1000
        self._frames = announced if shown_s is None else len(shown_s)
        if self._frames <= 0:
            raise DataError(
                f"video {path} has no frame to decode: copy it again, or convert it to mp4 (H.264)"
            )
        if 0 < announced != self._frames:
            logger.warning(
                "video %s announces %d frames and has %d: it may be cut off, or of an uneven rate",
                path,
                announced,
                self._frames,
            )
        self._shown_s = None if shown_s is None or (np.diff(shown_s) <= 0).any() else shown_s
        self.fps = float(self._capture.get(cv2.CAP_PROP_FPS)) or None
        if self._shown_s is not None and self._frames > 1:
            self.fps = (self._frames - 1) / float(self._shown_s[-1] - self._shown_s[0])
        # weak, so that a video that nobody reads any more is closed at once: in a data loader, which is a
        # fork without FFmpeg's threads, closing it would wait for these for ever
        decode = functools.partial(VideoFrames._decode, weakref.proxy(self))
        self._cached = functools.lru_cache(maxsize=_CACHED_FRAMES)(decode)
        self.height, self.width = self._cached(0).shape[:2]
        wide = self._capture.get(cv2.CAP_PROP_SAR_NUM)
        high = self._capture.get(cv2.CAP_PROP_SAR_DEN)
        self.pixel_aspect = wide / high if wide > 0 and high > 0 else 1.0
        if (
            self._capture.get(cv2.CAP_PROP_ORIENTATION_META) % 180
        ):  # the frames are turned, it is not
            self.pixel_aspect = 1.0 / self.pixel_aspect

    def __len__(self) -> int:
        """Number of frames."""
        return self._frames

    def read(self, index: int) -> Image:
        """One frame ``(height, width, 3)`` uint8 RGB."""
        return self._cached(index).copy()

    def times_s(self) -> NDArray[np.float64] | None:
        """When each frame is shown, seconds ``(N,)``; None, with a warning, where that is not known."""
        if self._shown_s is None:
            logger.warning(
                "video %s has frame times that do not increase, or it is long and PyAV is missing (pip install "
                "'erfsfm-slam[video]'); its frames are taken as even",
                self._path,
            )
        return self._shown_s

    def _decode(self, index: int) -> Image:
        ahead = index - self._next
        unseen = index >= len(self._times_ms)  # so that no seek could be checked
        if not (ahead >= 0 and (unseen or ahead <= _SKIPPED_FRAMES)) and not self._seek(index):
            self._capture, self._next = _capture(self._path), 0
        while self._next <= index:
            if not self._grab():
                raise DataError(
                    f"video {self._path} breaks off at frame {self._next}: use the frames 0:{self._next}"
                )
        read, image = self._capture.retrieve()
        if not read:
            raise DataError(f"video {self._path} frame {index} cannot be decoded: copy it again")
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def _grab(self) -> bool:
        """Go to the next frame and note its time."""
        if not self._capture.grab():
            return False
        if self._next == len(self._times_ms):
            self._times_ms.append(self._capture.get(cv2.CAP_PROP_POS_MSEC))
        self._next += 1
        return True

    def _seek(self, index: int) -> bool:
        """Go to just before a frame seen before; False where the seek landed elsewhere."""
        if not 0 < index < len(self._times_ms):
            return False
        self._capture.set(cv2.CAP_PROP_POS_FRAMES, index - 1)
        if (
            not self._capture.grab()
            or self._capture.get(cv2.CAP_PROP_POS_MSEC) != self._times_ms[index - 1]
        ):
            return False
        self._next = index
        return True


def _packet_times(path: Path) -> NDArray[np.float64] | None:
    """Of the frames shown of the first video stream, in the order of time, without decoding; None without PyAV."""
    try:
        av = importlib.import_module("av")
    except ImportError:
        return None
    try:
        with av.open(str(path.absolute())) as container:
            stream = container.streams.video[0]
            shown = sorted(
                packet.pts
                for packet in container.demux(stream)
                if packet.pts is not None and not packet.is_discard  # trimmed on a phone
            )
            return np.array(shown, dtype=np.float64) * float(stream.time_base)
    except (av.error.FFmpegError, IndexError, TypeError) as error:
        raise DataError(f"video {path} cannot be read: {error}; copy it again") from error


def list_videos(folder: Path) -> list[Path]:
    """The video files directly in a folder, without hidden ones."""
    found = []
    for path in folder.iterdir():
        is_video = path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()
        if is_video and not path.name.startswith("."):
            found.append(path)
    return sorted(found)


def video_name(video: Path) -> str:
    """The name of the folder, as `recording_folder`; of one of several videos its own name, too: ``my_drive/clip2``."""
    folder = video.absolute().parent
    name = recording_folder(folder).name
    return f"{name}/{clip_name(video)}" if len(list_videos(folder)) > 1 else name


def clip_name(video: Path) -> str:
    """The name of a video in its folder: without its suffix, unless another one differs from it in that alone."""
    stems = [path.stem for path in list_videos(video.absolute().parent)]
    return video.stem if stems.count(video.stem) < 2 else video.name


def _capture(path: Path) -> cv2.VideoCapture:
    os.environ.setdefault(
        "OPENCV_FFMPEG_LOGLEVEL", _QUIET
    )  # errors are reported by DataError alone
    capture = cv2.VideoCapture(str(path.absolute()))
    if not capture.isOpened():
        raise DataError(
            f"video {path} cannot be opened: copy it again, or convert it to mp4 (H.264)"
        )
    return capture
