"""TUM RGB-D folders: ``rgb.txt`` and, where known, ``groundtruth.txt`` (Sturm et al. 2012)."""

from __future__ import annotations

import math
import re
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from erfsfm.common.files import read_text
from erfsfm.common.readers.camera_file import CameraFile
from erfsfm.common.readers.numbering import by_table
from slam.formats.rows import BadRows, in_seconds, number_or_nan
from slam.formats.trajectory import nearest_stamps, read_trajectory
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import beside, find_camera_file
from slam.sequences.depth_maps import DepthMaps
from slam.sequences.images import ImageFiles
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.poses import poses_near
from slam.sequences.recording import RecordedSequence, Source

INDEX_FILE = "rgb.txt"
_DEPTH_INDEX = "depth.txt"
_DEPTH_PER_METRE = 5000.0
_MAX_DEPTH_DELAY_S = 0.02
_PUBLISHED_NAME = re.compile(r"freiburg(?P<camera>[123])")


def _published(focal: tuple[float, float], centre: tuple[float, float], *distortion: float) -> CameraFile:
    (fx, fy), (cx, cy) = focal, centre
    model: Literal["opencv", "pinhole"] = "opencv" if distortion else "pinhole"
    return CameraFile(width=640, height=480, fx=fx, fy=fy, cx=cx, cy=cy, fps=30.0, model=model, distortion=distortion)


# the benchmark's table of its three cameras; images of freiburg3 are undistorted
_PUBLISHED = {
    "1": _published((517.3, 516.5), (318.6, 255.3), 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "2": _published((520.9, 521.0), (325.1, 249.7), 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "3": _published((535.4, 539.2), (320.1, 247.6)),
}


def open_tum(folder: Path, asked: Path | None) -> RecordedSequence:
    """Open a TUM folder; poses of the ground truth are interpolated, and rows without an image are gaps in time.

    Without a ``camera.yaml``, sequences of the benchmark have the published camera by the name of their folder.

    Raises:
        SequenceError, DataError: if ``rgb.txt`` has no good row, or none of its images is there.
    """
    table = folder / INDEX_FILE
    stamps, paths = _read_index(table)
    files = by_table(paths, table)
    stamps = stamps[files.first :][: len(files)]
    stored = ImageFiles(files)
    camera = _camera(folder, stored, asked)
    name = folder.absolute().name
    return RecordedSequence(
        name=name,
        images=stored,
        camera=camera,
        stamps=stamps,
        sources=(Source(f"tum/{name}"),),
        T_any_camera=_true_poses(folder / "groundtruth.txt", stamps),
        depth_maps=_depth_maps(folder, stamps),
    )


def _camera(folder: Path, images: ImageFiles, asked: Path | None) -> CameraFile:
    match = _PUBLISHED_NAME.search(folder.absolute().name)
    places = (folder, folder.absolute().parent)
    if match is None or asked is not None or beside(*places) is not None:
        return find_camera_file(asked, *places, wanted_by=f"TUM folder {folder}", images=images)
    return _PUBLISHED[match["camera"]]


def _read_index(path: Path) -> tuple[FloatArray, list[Path]]:
    """Stamps and paths of ``rgb.txt`` or ``depth.txt``, without bad rows."""
    bad = BadRows(path, SequenceError)
    rows = []
    for line, text in enumerate(_text(path).splitlines(), start=1):
        words = text.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        stamp = number_or_nan(in_seconds(words[0]))
        if len(words) == 2 and math.isfinite(stamp):
            rows.append((line, stamp, path.parent / words[1]))
        else:
            bad.add(line, f"{text!r} is not 'stamp file'")
    return bad.ordered(rows, "rows of 'stamp file'")


def _text(path: Path) -> str:
    try:
        return read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise SequenceError(f"{path} cannot be read ({error}): it needs rows of 'stamp file' in UTF-8") from error


def _depth_maps(folder: Path, stamps: FloatArray) -> DepthMaps | None:
    """The registered depth maps of ``depth.txt`` whose stamps are within 20 ms of an image's."""
    if not (folder / _DEPTH_INDEX).exists():
        return None
    known, paths = _read_index(folder / _DEPTH_INDEX)
    nearest = nearest_stamps(stamps, known)
    close = np.abs(known[nearest] - stamps) <= _MAX_DEPTH_DELAY_S
    return DepthMaps({int(k): paths[nearest[k]] for k in np.flatnonzero(close)}, _DEPTH_PER_METRE)


def _true_poses(path: Path, stamps: FloatArray) -> FloatArray | None:
    """``T_any_camera`` at the images' stamps, NaN where the ground truth does not cover them; None without it."""
    if not path.exists():
        return None
    truth = read_trajectory(path, format="tum")
    return poses_near(truth.T_world_camera, truth.stamps, stamps, path)


def _find(path: Path, asked: Asked) -> dict[str, Opener]:
    if not (path / INDEX_FILE).exists():
        return {}
    return {path.absolute().name: partial(open_tum, path, asked.camera)}


LOADER = Loader("TUM RGB-D", INDEX_FILE, _find)
