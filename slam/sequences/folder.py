"""A folder of images with a ``camera.yaml`` and perhaps a ``times.txt``."""

from __future__ import annotations

import logging
import re
from functools import partial
from pathlib import Path

import numpy as np

from erfsfm.common.readers.images import image_folder, list_images, recording_name
from erfsfm.common.readers.numbering import NumberedFiles, by_name
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import find_camera_file
from slam.sequences.images import ImageFiles
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.recording import RecordedSequence, Source, read_stamps, uniform_stamps

logger = logging.getLogger(__name__)

TIMES = ("times.txt", "timestamps.txt", "times.csv", "timestamps.csv")
# seconds since 1970 with decimals, milli-, micro- or nanoseconds
_NAMED_BY_TIME = re.compile(r"(?:\D*[_-])?(\d{10})(?:[._])?(\d{3,9})")


def open_folder(folder: Path, asked: Path | None) -> RecordedSequence:
    """Open a folder of images in natural order, at the stamps of its ``times.txt`` or the camera's frame rate.

    Raises:
        SequenceError: if it holds none, the gaps between them are too long, or they do not fit the camera.
        DataError: if the first image cannot be read.
    """
    where = image_folder(folder)
    if where is None:
        raise SequenceError(f"no images in {folder}: looked for png, jpg, bmp there and in its sub-folders")
    files = by_name(list_images(where))
    stored = ImageFiles(files)
    places = (where, folder, folder.absolute().parent)
    camera = find_camera_file(asked, *places, wanted_by=f"images in {where}", images=stored)
    stamps = _stamps([place / name for place in (where, folder) for name in TIMES], files, camera.fps)
    name = recording_name(folder)
    return RecordedSequence(
        name=name,
        images=stored,
        camera=camera,
        stamps=stamps,
        sources=(Source(f"folder/{name}"),),
    )


def _stamps(places: list[Path], files: NumberedFiles, fps: float) -> FloatArray:
    """By a file, by names that are times since 1970, or at the rate of the camera."""
    path = next((path for path in places if path.exists()), None)
    if path is not None:
        return read_stamps(path, files)
    times = [_NAMED_BY_TIME.fullmatch(path.stem) for path in files.paths]
    if len(times) == len(files) and all(times):
        stamps = np.array([float(f"{match[1]}.{match[2]}") for match in times if match is not None])
        if (np.diff(stamps) > 0).all():
            logger.info("%s: names are taken for the times of the images", files.paths[0].parent)
            return np.asarray(stamps)
    return uniform_stamps(len(files), fps)


def _find(path: Path, asked: Asked) -> dict[str, Opener]:
    if image_folder(path) is None:
        return {}
    return {path.absolute().name: partial(open_folder, path, asked.camera)}


LOADER = Loader("images", "images/*.png, *.jpg or *.bmp", _find)
