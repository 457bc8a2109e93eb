"""TUM's monocular benchmark: ``images/``, ``times.txt`` and ``camera.txt`` with the FOV lens (Engel et al. 2016)."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from erfsfm.common.files import read_text
from erfsfm.common.readers.camera_file import CameraFile, camera_of
from erfsfm.common.readers.images import has_images, list_images
from erfsfm.common.readers.numbering import by_name
from slam.formats.trajectory import read_trajectory
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import own_camera
from slam.sequences.images import ImageFiles
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.poses import poses_near
from slam.sequences.recording import RecordedSequence, Source, read_stamps

_CAMERA, _TIMES, _TRUTH = "camera.txt", "times.txt", "groundtruthSync.txt"
_LENS = "FOV"


def open_tum_mono(folder: Path, asked: Path | None) -> RecordedSequence:
    """Open a sequence; response and vignette (``pcalib.txt``, ``vignette.png``) are not used.

    The benchmark gives true poses of the start and the end only.

    Raises:
        SequenceError, DataError: if images, ``camera.txt`` or ``times.txt`` are missing or malformed.
    """
    folder = folder.absolute()
    if not has_images(folder / "images"):
        raise SequenceError(f"no images in {folder / 'images'}: unpack images.zip there")
    files = by_name(list_images(folder / "images"))
    stored = ImageFiles(files)
    stamps = read_stamps(folder / _TIMES, files)
    fps = 1.0 / float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1.0
    camera = own_camera(partial(_camera, folder / _CAMERA, fps), asked, stored, folder)
    return RecordedSequence(
        name=folder.name,
        images=stored,
        camera=camera,
        stamps=stamps,
        sources=(Source(f"tum_mono/{folder.name}"),),
        T_any_camera=_true_poses(folder / _TRUTH, stamps),
    )


def _camera(path: Path, fps: float) -> CameraFile:
    """Focal lengths and principal point over the image's size, and the angle of the lens; then the size."""
    try:
        first, second = read_text(path).splitlines()[:2]
        words = first.split()
        fx, fy, cx, cy, angle = (float(word) for word in words[words[0] == _LENS :])
        width, height = (int(word) for word in second.split())
    except (OSError, UnicodeDecodeError, ValueError, IndexError) as error:
        raise SequenceError(
            f"{path} needs a row of fx fy cx cy and the lens's angle and a row of width and height: {error}"
        ) from error
    keys = {"fx": fx * width, "fy": fy * height, "cx": cx * width - 0.5, "cy": cy * height - 0.5}
    lens = {"model": "fov", "distortion": [angle]} if angle else {}
    return camera_of({"width": width, "height": height, "fps": fps, **keys, **lens}, str(path))


def _true_poses(path: Path, stamps: FloatArray) -> FloatArray | None:
    """``T_any_camera`` at the images' stamps, NaN where unknown; None without the file."""
    if not path.exists():
        return None
    truth = read_trajectory(path, "tum")
    return poses_near(truth.T_world_camera, truth.stamps, stamps, path)


def _find(path: Path, asked: Asked) -> dict[str, Opener]:
    if not ((path / _CAMERA).is_file() and (path / _TIMES).is_file()):
        return {}
    return {path.absolute().name: partial(open_tum_mono, path, asked.camera)}


LOADER = Loader("TUM mono", f"{_CAMERA} and {_TIMES}", _find)
