"""A video file with a ``camera.yaml``, or its field of view."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path

import numpy as np

from erfsfm.common.readers.video import VIDEO_SUFFIXES, VideoFrames, clip_name, list_videos, video_name
from slam.geometry.se3 import FloatArray
from slam.sequences.camera_file import find_camera_file
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.recording import RecordedSequence, Source, uniform_stamps

logger = logging.getLogger(__name__)

_UNEVEN = 0.25  # of an interval
_RATE_TOLERANCE = 0.1


def open_video(path: Path, asked: Path | None) -> RecordedSequence:
    """Open a video, turned as its rotation flag says, at the camera's frame rate or at its own frame times.

    Raises:
        DataError: if it cannot be decoded.
        SequenceError: if it does not fit the camera.
    """
    folder = path.absolute().parent
    frames = VideoFrames(path)
    camera = find_camera_file(asked, folder, wanted_by=f"video {path}", images=frames, fps=frames.fps)
    return RecordedSequence(
        name=clip_name(path),
        images=frames,
        camera=camera,
        stamps=_stamps(path, frames, camera.fps),
        sources=(Source(f"folder/{video_name(path)}"),),
    )


def _stamps(path: Path, frames: VideoFrames, fps: float) -> FloatArray:
    """The video's own frame times; at the camera's rate where those agree, are of another rate or unknown."""
    even, times_s = uniform_stamps(len(frames), fps), frames.times_s()
    rates = [frames.fps] if frames.fps else []
    if rates and times_s is not None and len(times_s) > 1:
        rates.append(1.0 / float(np.median(np.diff(times_s))))  # missing frames lower the mean rate alone
    if rates and all(abs(rate / fps - 1) > _RATE_TOLERANCE for rate in rates):
        logger.warning(
            "%s has %.4g frames a second, the camera has %g: taken as even at the camera's rate; correct fps, unless "
            "the video plays faster or slower than it was taken",
            path,
            frames.fps,
            fps,
        )
        return even
    if times_s is None:
        return even
    shown: FloatArray = times_s - times_s[0]
    if np.abs(shown - even).max() * fps < _UNEVEN:
        return even
    logger.info("%s has %.6g frames a second: its own frame times are used", path, frames.fps)
    return shown


def _find(path: Path, asked: Asked) -> dict[str, Opener]:
    files = [path] if path.is_file() else list_videos(path)
    videos = (file for file in files if file.suffix.lower() in VIDEO_SUFFIXES)
    return {clip_name(video): partial(open_video, video, asked.camera) for video in videos}


LOADER = Loader("video", "a video", _find)
