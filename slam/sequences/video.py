"""A video file with a ``camera.yaml``."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from erfsfm.readers.video import VIDEO_SUFFIXES, VideoFrames, list_videos
from slam.sequences.camera_file import find_camera_file
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.recording import RecordedSequence, Source, uniform_stamps
from slam.sequences.undistortion import calibrated


def open_video(path: Path, asked: Path | None) -> RecordedSequence:
    """Open a video at the camera file's frame rate.

    Raises:
        DataError: if it cannot be decoded.
        SequenceError: if it does not fit the camera.
    """
    folder = path.absolute().parent
    frames = VideoFrames(path)
    camera = find_camera_file(asked, folder, wanted_by=f"video {path}", images=frames)
    images, intrinsics = calibrated(frames, camera, str(path))
    return RecordedSequence(
        name=path.stem,
        images=images,
        intrinsics=intrinsics,
        stamps=uniform_stamps(len(frames), camera.fps),
        sources=(Source(f"folder/{folder.name}"),),
        camera_height_m=camera.height_or(None),
    )


def _find(path: Path, asked: Asked) -> dict[str, Opener]:
    files = [path] if path.is_file() else list_videos(path)
    videos = (file for file in files if file.suffix.lower() in VIDEO_SUFFIXES)
    return {video.stem: partial(open_video, video, asked.camera) for video in videos}


LOADER = Loader("video", "a video", _find)
