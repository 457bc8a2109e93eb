"""A video file with a ``camera.yaml``, or its field of view."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path

import numpy as np

from erfsfm.errors import DataError
from erfsfm.readers.video import VIDEO_SUFFIXES, VideoFrames, list_videos
from slam.se3 import FloatArray
from slam.sequences.camera_file import find_camera_file
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.recording import RecordedSequence, Source, uniform_stamps
from slam.sequences.undistortion import calibrated

logger = logging.getLogger(__name__)

_UNEVEN = 0.25  # of an interval
_RATE_TOLERANCE = 0.1


def open_video(path: Path, asked: Path | None) -> RecordedSequence:
    """Open a video, turned as its rotation flag says, at the camera's frame rate or at its own uneven frame times.

    Raises:
        DataError: if it cannot be decoded.
        SequenceError: if it does not fit the camera.
    """
    folder = path.absolute().parent
    frames = VideoFrames(path)
    times_s = _times(frames, path)
    own_fps = None if times_s is None else (len(times_s) - 1) / float(times_s[-1] - times_s[0])
    camera = find_camera_file(asked, folder, wanted_by=f"video {path}", images=frames, fps=own_fps)
    images, intrinsics = calibrated(frames, camera, str(path))
    return RecordedSequence(
        name=path.stem,
        images=images,
        intrinsics=intrinsics,
        stamps=_stamps(path, times_s, len(frames), camera.fps),
        sources=(Source(f"folder/{folder.name}"),),
        camera_height_m=camera.height_or(None),
    )


def _times(frames: VideoFrames, path: Path) -> FloatArray | None:
    """The video's own frame times; None, with a warning, where they cannot be read."""
    if len(frames) == 1:
        return None
    try:
        return frames.times_s()
    except DataError as error:
        logger.warning("%s; its frames are taken as even", error)
        return None


def _stamps(path: Path, times_s: FloatArray | None, frames: int, fps: float) -> FloatArray:
    """Even stamps at the camera's rate; uneven times as they are, where that rate is not another one."""
    even = uniform_stamps(frames, fps)
    if times_s is None:
        return even
    shown: FloatArray = times_s - times_s[0]
    own_fps = (frames - 1) / float(shown[-1])
    if np.abs(shown - uniform_stamps(frames, own_fps)).max() * own_fps < _UNEVEN:
        return even
    if abs(own_fps / fps - 1) > _RATE_TOLERANCE:
        logger.warning(
            "%s has uneven frame times at %.4g frames a second, the camera has %g: taken as even", path, own_fps, fps
        )
        return even
    logger.info("%s has uneven frame times, %.4g frames a second: used as they are", path, own_fps)
    return shown


def _find(path: Path, asked: Asked) -> dict[str, Opener]:
    files = [path] if path.is_file() else list_videos(path)
    videos = (file for file in files if file.suffix.lower() in VIDEO_SUFFIXES)
    return {video.stem: partial(open_video, video, asked.camera) for video in videos}


LOADER = Loader("video", "a video", _find)
