"""One's own images: a folder of them and a ``camera.yaml``."""

from __future__ import annotations

from pathlib import Path

from slam.errors import SequenceError
from slam.sequences.camera_file import CameraFile
from slam.sequences.images import ImageFiles, has_images, list_images, require_no_gap
from slam.sequences.recording import Recording, Source, uniform_stamps
from slam.sequences.undistortion import calibrated

IMAGE_FOLDERS = ("images", "image_2", "image_02", "image_0", "image_00", "rgb", "data")


def image_folder(folder: Path) -> Path | None:
    """The folder that holds the images: itself, or its one sub-folder of a usual name.

    Raises:
        SequenceError: if several sub-folders qualify.
    """
    if has_images(folder):
        return folder
    found = [folder / name for name in IMAGE_FOLDERS if has_images(folder / name)]
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise SequenceError(f"{folder} has images in {names}: give one of these folders as --dataset")
    return found[0] if found else None


def recording_name(folder: Path) -> str:
    """The folder's name, or its parent's where the folder is only called ``images`` or the like."""
    folder = folder.absolute()
    return folder.parent.name if folder.name in IMAGE_FOLDERS and folder.parent.name else folder.name


def open_folder(folder: Path, camera: CameraFile) -> Recording:
    """Open a folder of images, in natural order at the camera file's frame rate.

    Raises:
        SequenceError: if it holds none, one is missing, or they do not fit the camera.
    """
    where = image_folder(folder)
    if where is None:
        raise SequenceError(f"no images in {folder}: looked for png, jpg, bmp there and in its sub-folders")
    paths = list_images(where)
    require_no_gap(paths)
    images, intrinsics = calibrated(ImageFiles(paths), camera, str(where))
    name = recording_name(folder)
    return Recording(
        name=name,
        images=images,
        intrinsics=intrinsics,
        stamps=uniform_stamps(len(paths), camera.fps),
        sources=(Source(f"folder/{name}"),),
        camera_height_m=camera.height_or(None),
    )
