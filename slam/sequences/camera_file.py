"""Which camera a sequence has: a calibration or a field of view given by the user, or the recording's own.

The keys of ``camera.yaml`` are described in `erfsfm.common.readers.camera_file`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from erfsfm.common.readers.camera_file import CAMERA_FILE, CameraFile, camera_of, read_camera_file
from slam.frames import Intrinsics
from slam.runtime.errors import SequenceError
from slam.sequences.foreign_camera import pinhole_keys, read_foreign_camera
from slam.sequences.images import Sized

DEFAULT_FPS = 10.0
_FOV = re.compile(r"fov=(?P<fov>\d+\.?\d*)(?:,fps=(?P<fps>\d+\.?\d*))?")
_FOV_LIMITS_DEG = (3.0, 150.0)


def find_camera_file(
    explicit: Path | None,
    *folders: Path,
    wanted_by: str,
    images: Sized,
    fps: float | None = None,
    own: Callable[[], CameraFile] | None = None,
) -> CameraFile:
    """The camera given by the user, or else the recording's own, or the first ``camera.yaml`` found in ``folders``.

    Args:
        explicit: a ``camera.yaml``, or ``fov=DEGREES[,fps=RATE]``.
        folders: where a ``camera.yaml`` may lie; where there is a calibration of the recording's own, it gives the
            height of the camera and its read-out alone.
        wanted_by: what needs it, for the message.
        images: the images that it took, for a camera by its field of view.
        fps: their rate where known, for the same; 10 a second otherwise.
        own: reads the calibration of the recording, where it has one; not called where the user gave another.

    Raises:
        SequenceError, DataError: there is none, or it is wrong.
    """
    if explicit is not None:
        return explicit_camera(explicit, images, fps)
    camera = None if own is None else own()
    found = beside(*folders, own=None if camera is None else camera.model_dump())
    if camera is not None and found is not None:
        return camera.model_copy(update={"camera_height_m": found.camera_height_m, "readout_ms": found.readout_ms})
    camera = camera or found
    if camera is not None:
        return camera
    places = " and ".join(dict.fromkeys(str(folder) for folder in folders))
    looked = f"looked in {places}; put one there or " if places else ""
    raise SequenceError(
        f"no {CAMERA_FILE} for {wanted_by}: {looked}give it with --camera (width, height, fx, fy, cx, cy, fps), or "
        "give the horizontal field of view in degrees, --camera fov=70"
    )


def explicit_camera(given: Path, images: Sized, fps: float | None = None) -> CameraFile:
    """The camera that the user named; arguments as in `find_camera_file`."""
    if is_field_of_view(given):
        return _of_field_of_view(str(given), images, fps or DEFAULT_FPS)
    return read_explicit(given, fps)


def read_explicit(path: Path, fps: float | None = None) -> CameraFile:
    """Read the camera file that the user named, ours or of another program; ``fps`` is for one without a rate."""
    if not path.is_file():
        raise SequenceError(f"no camera file {path}: give a {CAMERA_FILE}, or fov=DEGREES")
    return read_foreign_camera(path, fps or DEFAULT_FPS) or read_camera_file(path)


def beside(*folders: Path, own: Mapping[str, Any] | None = None) -> CameraFile | None:
    """The first ``camera.yaml`` found in ``folders``, or None; keys that it lacks are those of the ``own`` camera."""
    path = next((folder / CAMERA_FILE for folder in folders if (folder / CAMERA_FILE).exists()), None)
    return None if path is None else read_camera_file(path, own)


def as_known(intrinsics: Intrinsics, asked: Path | None) -> Intrinsics:
    """The same camera; a guess where the user gave a field of view alone."""
    return replace(intrinsics, is_guess=asked is not None and is_field_of_view(asked))


def is_field_of_view(given: Path) -> bool:
    """Whether the user named a field of view, not a file."""
    return str(given).startswith("fov=")


def _of_field_of_view(text: str, images: Sized, fps: float) -> CameraFile:
    """A pinhole with square pixels and the principal point in the middle; the field is that of the whole width."""
    match = _FOV.fullmatch(text)
    fov_deg = float(match["fov"]) if match else math.nan
    fps = float(match["fps"]) if match and match["fps"] else fps
    least, most = _FOV_LIMITS_DEG
    if not (least <= fov_deg <= most and fps > 0):
        raise SequenceError(
            f"{text} is no field of view: write fov=70 for 70 degrees from the left edge of the image to the "
            f"right, {least:g} to {most:g}, or fov=70,fps=30 for 30 frames a second as well"
        )
    focal_px = images.width / 2 / math.tan(math.radians(fov_deg) / 2)
    width, height, source = images.width, images.height, f"a horizontal field of view of {fov_deg:g} degrees"
    centre = (width - 1) / 2, (height - 1) / 2
    return camera_of(pinhole_keys(width, height, focal_px, focal_px, *centre, fps=fps, source=source), text)
