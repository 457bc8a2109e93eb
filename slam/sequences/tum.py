"""TUM RGB-D folders: ``rgb.txt`` and, where known, ``groundtruth.txt`` (Sturm et al. 2012)."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from erfsfm.files import read_text
from erfsfm.readers.camera_file import CameraFile
from erfsfm.readers.numbering import NumberedFiles
from slam.errors import SequenceError
from slam.se3 import FloatArray
from slam.sequences.depth_maps import DepthMaps
from slam.sequences.images import ImageFiles
from slam.sequences.recording import RecordedSequence, Source, interpolated_poses, rebased, require_stamps
from slam.sequences.undistortion import calibrated
from slam.trajectory import read_trajectory

logger = logging.getLogger(__name__)

INDEX_FILE = "rgb.txt"
_MAX_GAP_S = 0.1
_DEPTH_INDEX = "depth.txt"
_DEPTH_PER_METRE = 5000.0
_MAX_DEPTH_DELAY_S = 0.02


def open_tum(folder: Path, camera: CameraFile) -> RecordedSequence:
    """Open a TUM folder; poses of the ground truth are interpolated.

    Raises:
        SequenceError: if ``rgb.txt`` is malformed or names images that are missing.
    """
    stamps, paths = _read_index(folder / INDEX_FILE)
    files = NumberedFiles(tuple(paths), tuple(range(len(paths))))
    stored = ImageFiles(files)
    images, intrinsics = calibrated(stored, camera, str(folder))
    name = folder.absolute().name
    return RecordedSequence(
        name=name,
        images=images,
        intrinsics=intrinsics,
        stamps=require_stamps(stamps, folder / INDEX_FILE, files),
        sources=(Source(f"tum/{name}"),),
        reference=_reference(folder / "groundtruth.txt", stamps),
        camera_height_m=camera.height_or(None),
        depth_maps=_depth_maps(folder, stamps) if images is stored else None,
    )


def _read_index(path: Path) -> tuple[FloatArray, list[Path]]:
    """Stamps and image paths of ``rgb.txt`` or ``depth.txt``."""
    stamps, paths = [], []
    for number, line in enumerate(_text(path).splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            stamp, name = words
            stamps.append(float(stamp))
        except ValueError:
            raise SequenceError(f"{path} line {number} is not 'stamp file': {line!r}; correct it") from None
        paths.append(path.parent / name)
    if not paths:
        raise SequenceError(f"{path} names no images: it needs rows of 'stamp file'")
    missing = next((p for p in paths if not p.is_file()), None)
    if missing is not None:
        raise SequenceError(f"no image {missing}, which {path} names: restore it or remove the row")
    return np.array(stamps), paths


def _text(path: Path) -> str:
    try:
        return read_text(path, "utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SequenceError(f"{path} cannot be read ({error}): it needs rows of 'stamp file' in UTF-8") from error


def _depth_maps(folder: Path, stamps: FloatArray) -> DepthMaps | None:
    """The registered depth maps of ``depth.txt`` whose stamps are within 20 ms of an image's."""
    if not (folder / _DEPTH_INDEX).is_file():
        return None
    known, paths = _read_index(folder / _DEPTH_INDEX)
    nearest = np.abs(known[None] - stamps[:, None]).argmin(axis=1)
    close = np.abs(known[nearest] - stamps) <= _MAX_DEPTH_DELAY_S
    return DepthMaps({int(k): paths[nearest[k]] for k in np.flatnonzero(close)}, _DEPTH_PER_METRE)


def _reference(path: Path, stamps: FloatArray) -> FloatArray | None:
    """``T_world_camera`` at the images' stamps, or None where the ground truth does not cover them."""
    if not path.is_file():
        return None
    truth = read_trajectory(path, format="tum")
    known, T_any_camera = truth.stamps, truth.T_world_camera
    if len(known) < 2:
        return None
    before = np.clip(np.searchsorted(known, stamps, side="right") - 1, 0, len(known) - 2)
    gap = np.minimum(np.abs(stamps - known[before]), np.abs(known[before + 1] - stamps))
    if (gap > _MAX_GAP_S).any():
        bad = int(np.argmax(gap > _MAX_GAP_S))
        logger.warning(
            "%s has no pose within %g s of image %d (stamp %.6f): the sequence has no reference",
            path,
            _MAX_GAP_S,
            bad,
            stamps[bad],
        )
        return None
    return rebased(interpolated_poses(T_any_camera, known, stamps))
