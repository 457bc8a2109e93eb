"""Search for the ``camera.yaml`` of a sequence; its keys are described in `erfsfm.readers.camera_file`."""

from __future__ import annotations

from pathlib import Path

from erfsfm.readers.camera_file import CAMERA_FILE, CameraFile, read_camera_file
from slam.errors import SequenceError, sequence_errors


@sequence_errors()
def find_camera_file(explicit: Path | None, *folders: Path, wanted_by: str) -> CameraFile:
    """The camera file given by the user, or else the first ``camera.yaml`` found in ``folders``.

    Raises:
        SequenceError: if there is none, or it is wrong.
    """
    if explicit is not None:
        return read_explicit(explicit)
    found = beside(*folders)
    if found is not None:
        return found
    places = " and ".join(dict.fromkeys(str(folder) for folder in folders))
    raise SequenceError(
        f"no {CAMERA_FILE} for {wanted_by}: looked in {places}; put one there or give it with --camera "
        f"(width, height, fx, fy, cx, cy, fps)"
    )


@sequence_errors()
def read_explicit(path: Path) -> CameraFile:
    """Read the camera file that the user named.

    Raises:
        SequenceError: if it does not exist or is wrong.
    """
    if not path.is_file():
        raise SequenceError(f"no camera file {path}: --camera needs a {CAMERA_FILE}")
    return read_camera_file(path)


@sequence_errors()
def beside(*folders: Path) -> CameraFile | None:
    """The first ``camera.yaml`` found in ``folders``, or None.

    Raises:
        SequenceError: if it is wrong.
    """
    path = next((folder / CAMERA_FILE for folder in folders if (folder / CAMERA_FILE).is_file()), None)
    return None if path is None else read_camera_file(path)
