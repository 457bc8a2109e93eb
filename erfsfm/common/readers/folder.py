"""Folders of a user's own images and videos: where in them the images are, and what the recordings are called."""

from __future__ import annotations

from pathlib import Path

from erfsfm.common.errors import DataError
from erfsfm.common.readers.images import has_images
from erfsfm.common.readers.video import list_videos

IMAGE_FOLDERS = ("images", "image_2", "image_02", "image_0", "image_00", "rgb", "data")  # never a name of a drive


def image_folder(folder: Path) -> Path | None:
    """The folder that holds the images: itself, or its one sub-folder of a usual name.

    Raises:
        DataError: several sub-folders qualify.
    """
    if has_images(folder):
        return folder
    found = [folder / name for name in IMAGE_FOLDERS if has_images(folder / name)]
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise DataError(f"{folder} has images in {names}: give one of these folders as --dataset")
    return found[0] if found else None


def recording_name(folder: Path) -> str:
    """The folder's name, or its parent's where the folder is only called ``images`` or the like."""
    folder = folder.absolute()
    return folder.parent.name if folder.name in IMAGE_FOLDERS and folder.parent.name else folder.name


def video_name(video: Path) -> str:
    """The name of the folder, as `recording_name`; of one of several videos its own name, too: ``my_drive/clip2``."""
    folder = video.absolute().parent
    name = recording_name(folder)
    return f"{name}/{clip_name(video)}" if len(list_videos(folder)) > 1 else name


def clip_name(video: Path) -> str:
    """The name of a video in its folder: without its suffix, unless another one differs from it in that alone."""
    stems = [path.stem for path in list_videos(video.absolute().parent)]
    return video.stem if stems.count(video.stem) < 2 else video.name
