"""A folder of images with a ``camera.yaml``."""

from __future__ import annotations

from pathlib import Path

from erfsfm.readers.camera_file import CameraFile
from erfsfm.readers.folder import image_folder, recording_name
from erfsfm.readers.images import list_images
from erfsfm.readers.numbering import by_name
from slam.errors import SequenceError
from slam.sequences.images import ImageFiles
from slam.sequences.recording import RecordedSequence, Source, require_short_gaps, uniform_stamps
from slam.sequences.undistortion import calibrated


def open_folder(folder: Path, camera: CameraFile) -> RecordedSequence:
    """Open a folder of images, in natural order at the camera file's frame rate.

    Raises:
        SequenceError: if it holds none, the gaps between them are too long, or they do not fit the camera.
        DataError: if the first image cannot be read.
    """
    where = image_folder(folder)
    if where is None:
        raise SequenceError(f"no images in {folder}: looked for png, jpg, bmp there and in its sub-folders")
    files = by_name(list_images(where))
    images, intrinsics = calibrated(ImageFiles(files), camera, str(where))
    stamps = uniform_stamps(len(files), camera.fps)
    require_short_gaps(files, stamps)
    name = recording_name(folder)
    return RecordedSequence(
        name=name,
        images=images,
        intrinsics=intrinsics,
        stamps=stamps,
        sources=(Source(f"folder/{name}"),),
        camera_height_m=camera.height_or(None),
    )
