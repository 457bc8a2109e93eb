"""7-Scenes' layout: ``seq-01/frame-000000.{color.png,depth.png,pose.txt}`` (Shotton et al. 2013)."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from erfsfm.common.readers.camera_file import CameraFile
from erfsfm.common.readers.numbering import by_table
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import own_camera
from slam.sequences.depth_maps import depth_maps_of
from slam.sequences.images import ImageFiles
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.poses import describe_unknown, known_poses, read_pose_files
from slam.sequences.recording import RecordedSequence, Source

_IMAGE = re.compile(r"frame-(\d{6})\.color\.png")
_FPS = 30.0
_PUBLISHED = CameraFile(width=640, height=480, fx=585.0, fy=585.0, cx=320.0, cy=240.0, fps=_FPS)
_PER_METRE, _UNKNOWN = 1000.0, 65535


def open_seven_scenes(folder: Path, asked: Path | None) -> RecordedSequence:
    """Open one sequence of a scene, with the camera that the data set publishes for all.

    Raises:
        SequenceError, DataError: if its files are malformed.
    """
    folder = folder.absolute()
    numbers = sorted(int(match[1]) for path in folder.iterdir() if (match := _IMAGE.fullmatch(path.name)))
    if not numbers:
        raise SequenceError(f"no frame-NNNNNN.color.png in {folder}: unpack the sequence")
    frames = range(numbers[0], numbers[-1] + 1)
    files = by_table([folder / f"frame-{k:06d}.color.png" for k in frames], folder)
    stored = ImageFiles(files)
    camera = own_camera(lambda: _PUBLISHED, asked, stored, folder, folder.parent)
    stamps = np.array(frames) / _FPS
    T_any_camera = read_pose_files([folder / f"frame-{k:06d}.pose.txt" for k in frames])
    if known_poses(T_any_camera).any():
        describe_unknown(T_any_camera, folder)
    depth = [folder / f"frame-{k:06d}.depth.png" for k in frames]
    name = f"{folder.parent.name}_{folder.name}"
    return RecordedSequence(
        name=name,
        images=stored,
        camera=camera,
        stamps=stamps,
        sources=(Source(f"7scenes/{name}", first=numbers[0]),),
        T_any_camera=T_any_camera,
        depth_maps=depth_maps_of(depth, _PER_METRE, _UNKNOWN),
    )


def _is_sequence(path: Path) -> bool:
    return path.is_dir() and any(path.glob("frame-*.color.png"))


def _find(path: Path, asked: Asked) -> dict[str, Opener]:
    """The sequences of a scene, or the one that is given."""
    found = [path] if _is_sequence(path) else sorted(filter(_is_sequence, path.glob("seq-*")))
    return {folder.absolute().name: partial(open_seven_scenes, folder, asked.camera) for folder in found}


LOADER = Loader("7-Scenes", "seq-01/frame-000000.color.png", _find)
