"""A kind of recording in the catalogue: how it is recognised, and how its sequences are opened.

Two kinds are here: a user's own folders of images and videos, with a ``camera.yaml`` or a field of view.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from erfsfm.common.readers.images import image_folder, list_images, recording_folder
from erfsfm.common.readers.numbering import NumberedFiles, by_name
from erfsfm.common.readers.video import (
    VIDEO_SUFFIXES,
    VideoFrames,
    clip_name,
    list_videos,
    video_name,
)
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import find_camera_file
from slam.sequences.images import ImageFiles
from slam.sequences.recording import RecordedSequence, Source, read_stamps, uniform_stamps

logger = logging.getLogger(__name__)

Opener = Callable[[], RecordedSequence]
Openers = dict[str, Opener]  # of sequences by name
TIMES = ("times.txt", "timestamps.txt", "times.csv", "timestamps.csv")
_UNEVEN = 0.25  # of an interval
_RATE_TOLERANCE = 0.1
# seconds since 1970 with decimals, milli-, micro- or nanoseconds
_NAMED_BY_TIME = re.compile(r"(?:\D*[_-])?(\d{10})(?:[._])?(\d{3,9})")


@dataclass(frozen=True)
class Asked:
    """Options of the user beside the data set.

    Attributes:
        name: of a sequence, or None for the only one.
        camera: a ``camera.yaml`` in place of the recording's own calibration, or ``fov=DEGREES`` (`camera_file`).
    """

    name: str | None = None
    camera: Path | None = None


@dataclass(frozen=True)
class Loader:
    """One kind of recording; `slam.sequences.catalogue.LOADERS` lists all.

    Attributes:
        kind: what ``doctor`` calls it.
        layout: the files by which it is recognised, for the message about a folder of no known kind.
        find: the sequences under a path by name, and how to open each; empty where the path is of another kind. It
            reads no images.
    """

    kind: str
    layout: str
    find: Callable[[Path, Asked], Openers]


def open_folder(folder: Path, asked: Path | None) -> RecordedSequence:
    """Open a folder of images in natural order, at the stamps of a ``times.txt`` or the camera's frame rate.

    Raises:
        SequenceError: there are no images or no camera, or their stamps do not match.
        DataError: no image can be read, or the camera file is malformed.
    """
    where = image_folder(folder)
    if where is None:
        raise SequenceError(
            f"no images in {folder}: looked for png, jpg, bmp there and in its sub-folders"
        )
    files = by_name(list_images(where))
    stored = ImageFiles(files)
    places = (where, folder, folder.absolute().parent)
    camera = find_camera_file(asked, *places, wanted_by=f"images in {where}", images=stored)
    home = recording_folder(folder)
    stamps = _times_of_images(
        [place / name for place in (where, folder, home) for name in TIMES], files, camera.fps
    )
    name = home.name
    return RecordedSequence(name, stored, camera, stamps, (Source(f"folder/{name}"),))


def _times_of_images(places: list[Path], files: NumberedFiles, fps: float) -> FloatArray:
    """By a file, by names that are times since 1970, or at the rate of the camera."""
    for place in places:
        if place.exists():
            return read_stamps(place, files)
    times = [_NAMED_BY_TIME.fullmatch(path.stem) for path in files.paths]
    if len(times) == len(files) and all(times):
        stamps = np.array([float(f"{match[1]}.{match[2]}") for match in times if match is not None])
        if (np.diff(stamps) > 0).all():
            logger.info("%s: names are taken for the times of the images", files.paths[0].parent)
            return stamps
    return uniform_stamps(len(files), fps)


def _find_folder(path: Path, asked: Asked) -> Openers:
    if image_folder(path) is None:
        return {}
    return {path.absolute().name: partial(open_folder, path, asked.camera)}


def open_video(path: Path, asked: Path | None) -> RecordedSequence:
    """Open a video, turned as its rotation flag says, at the camera's frame rate or at its own frame times."""
    folder = path.absolute().parent
    frames = VideoFrames(path)
    camera = find_camera_file(
        asked, folder, wanted_by=f"video {path}", images=frames, fps=frames.fps
    )
    stamps, source = _times_of_frames(path, frames, camera.fps), f"folder/{video_name(path)}"
    return RecordedSequence(clip_name(path), frames, camera, stamps, (Source(source),))


def _times_of_frames(path: Path, frames: VideoFrames, fps: float) -> FloatArray:
    """The video's own frame times; at the camera's rate where those agree, are of another rate or unknown."""
    even, times_s = uniform_stamps(len(frames), fps), frames.times_s()
    rates = [frames.fps] if frames.fps else []
    if rates and times_s is not None and len(times_s) > 1:
        # missing frames lower the mean rate alone
        rates.append(1.0 / median(np.diff(times_s)))
    if rates and all(abs(rate / fps - 1) > _RATE_TOLERANCE for rate in rates):
        text = (
            "%s has %.4g frames a second, the camera has %g: taken as even at the camera's rate; correct fps, unless "
            "the video plays faster or slower than it was taken"
        )
        logger.warning(text, path, frames.fps, fps)
        return even
    if times_s is None:
        return even
    shown: FloatArray = times_s - times_s[0]
    if np.abs(shown - even).max() * fps < _UNEVEN:
        return even
    logger.info("%s has %.6g frames a second: its own frame times are used", path, frames.fps)
    return shown


def _find_video(path: Path, asked: Asked) -> Openers:
    files = [path] if path.is_file() else list_videos(path)
    videos = (file for file in files if file.suffix.lower() in VIDEO_SUFFIXES)
    return {clip_name(video): partial(open_video, video, asked.camera) for video in videos}


IMAGES = Loader("images", "images/*.png, *.jpg or *.bmp", _find_folder)
VIDEO = Loader("video", "a video", _find_video)
