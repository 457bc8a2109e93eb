"""ScanNet's layout as its reader exports it: ``{color/0.jpg,depth/0.png,pose/0.txt,intrinsic}`` (Dai et al. 2017)."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from erfsfm.common.files import read_text
from erfsfm.common.readers.camera_file import CameraFile, camera_of
from erfsfm.common.readers.images import has_images, list_images
from erfsfm.common.readers.numbering import by_name
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import Sized, own_camera
from slam.sequences.depth_maps import depth_maps_of
from slam.sequences.images import ImageFiles
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.poses import describe_unknown, read_pose_files
from slam.sequences.recording import RecordedSequence, Source

_INTRINSICS = "intrinsic/intrinsic_color.txt"
_FPS = 30.0
_PER_METRE = 1000.0


def open_scannet(folder: Path, asked: Path | None) -> RecordedSequence:
    """Open a scene: stamps follow from the numbers of the images at 30 a second, also where every n-th was exported.

    Raises:
        SequenceError, DataError: if its files are malformed, or images are not named by their numbers.
    """
    folder = folder.absolute()
    paths = list_images(folder / "color")
    unnamed = next((path for path in paths if not path.stem.isdecimal()), None)
    if unnamed is not None:
        raise SequenceError(f"{unnamed} is not named by its number, as 0.jpg: rename it")
    files = by_name(paths)
    stored = ImageFiles(files)
    camera = own_camera(partial(_camera, folder / _INTRINSICS, stored), asked, stored, folder)
    there = [int(path.stem) for path in files.paths]
    numbers = np.interp(np.arange(len(files)), files.rows, there).round().astype(int).tolist()
    stamps = np.array(numbers) / _FPS
    T_any_camera = read_pose_files([folder / "pose" / f"{k}.txt" for k in numbers])
    describe_unknown(T_any_camera, folder / "pose")
    depth = [folder / "depth" / f"{k}.png" for k in numbers]
    return RecordedSequence(
        name=folder.name,
        images=stored,
        camera=camera,
        stamps=stamps,
        sources=(Source(f"scannet/{folder.name}", first=numbers[0]),),
        T_any_camera=T_any_camera,
        depth_maps=depth_maps_of(depth, _PER_METRE),
    )


def _camera(path: Path, images: Sized) -> CameraFile:
    """The camera of a file of 4 x 4 numbers."""
    try:
        K = np.array(read_text(path).split(), dtype=np.float64).reshape(4, 4)
    except (OSError, ValueError) as error:
        raise SequenceError(f"{path} must hold the 4 x 4 numbers of a camera: {error}") from error
    keys = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    return camera_of({"width": images.width, "height": images.height, "fps": _FPS, **keys}, str(path))


def _find(path: Path, asked: Asked) -> dict[str, Opener]:
    if not (path / _INTRINSICS).is_file() or not has_images(path / "color"):
        return {}
    return {path.absolute().name: partial(open_scannet, path, asked.camera)}


LOADER = Loader("ScanNet", f"color/0.jpg with {_INTRINSICS}", _find)
