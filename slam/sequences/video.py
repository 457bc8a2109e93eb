"""A video file with a ``camera.yaml``."""

from __future__ import annotations

from pathlib import Path

from erfsfm.readers.camera_file import CameraFile
from erfsfm.readers.video import VideoFrames
from slam.sequences.recording import RecordedSequence, Source, uniform_stamps
from slam.sequences.undistortion import calibrated


def open_video(path: Path, camera: CameraFile) -> RecordedSequence:
    """Open a video at the camera file's frame rate.

    Raises:
        DataError: if it cannot be decoded.
        SequenceError: if it does not fit the camera.
    """
    frames = VideoFrames(path)
    images, intrinsics = calibrated(frames, camera, str(path))
    return RecordedSequence(
        name=path.stem,
        images=images,
        intrinsics=intrinsics,
        stamps=uniform_stamps(len(frames), camera.fps),
        sources=(Source(f"folder/{path.absolute().parent.name}"),),
        camera_height_m=camera.height_or(None),
    )
