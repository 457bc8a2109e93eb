"""EuRoC's layout: ``mav0/cam0/{data.csv,sensor.yaml,data/STAMP.png}`` (Burri et al. 2016)."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from erfsfm.common.errors import ErfsfmError
from erfsfm.common.files import read_text
from erfsfm.common.readers.camera_file import CameraFile, camera_of
from erfsfm.common.readers.numbering import by_table
from erfsfm.common.yaml_file import parse_yaml
from slam.formats.rows import BadRows
from slam.formats.trajectory import read_trajectory
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import own_camera
from slam.sequences.images import ImageFiles
from slam.sequences.loader import Asked, Loader, Opener
from slam.sequences.poses import poses_near
from slam.sequences.recording import RecordedSequence, Source

logger = logging.getLogger(__name__)

_CAMERAS = ("cam0", "cam1")
_TRUTH = ("state_groundtruth_estimate0", "mocap0", "vicon0")  # the first that is there
_POSITIONS = "leica0"
_NANOSECONDS = 10**9
_RIGID_TOLERANCE = 0.01
_MODELS: dict[str, Literal["pinhole", "opencv", "fisheye"]] = {
    "radial-tangential": "opencv",
    "radtan": "opencv",
    "plumb_bob": "opencv",
    "equidistant": "fisheye",
    "none": "pinhole",
}


def open_euroc(body: Path, asked: Path | None) -> RecordedSequence:
    """Open the left camera of a ``mav0`` folder, else the right one.

    Rows of ``data.csv`` without an image are gaps in time. True poses are those of the body, moved to the camera.

    Raises:
        SequenceError, DataError: if images, ``data.csv``, ``sensor.yaml`` or the true poses are missing or malformed.
    """
    body = body.absolute()
    folder = _camera_folder(body)
    assert folder is not None
    table = folder / "data.csv"
    stamps, listed = _read_index(table)
    files = by_table(listed, table)
    stored = ImageFiles(files)
    sensor = folder / "sensor.yaml"
    camera = own_camera(lambda: _read_sensor(sensor).camera(), asked, stored, body, body.parent)
    stamps = stamps[files.first :][: len(files)]
    name = body.parent.name
    return RecordedSequence(
        name=name,
        images=stored,
        camera=camera,
        stamps=stamps,
        sources=(Source(f"euroc/{name}"),),
        T_any_camera=_true_poses(body, stamps, sensor),
    )


@dataclass(frozen=True)
class _Sensor:
    """The keys of a ``sensor.yaml``."""

    path: Path
    keys: dict[str, Any]

    def T_body_sensor(self) -> FloatArray:
        """The pose of the sensor in the body ``(4, 4)``.

        Raises:
            SequenceError: there is none.
        """
        try:
            T_body_sensor = np.array(self.keys["T_BS"]["data"], dtype=np.float64).reshape(4, 4)
        except (KeyError, TypeError, ValueError) as error:
            raise SequenceError(f"{self.path} needs T_BS with data of 4 x 4 numbers: {error!r}") from error
        if not se3.is_se3(T_body_sensor, _RIGID_TOLERANCE):
            raise SequenceError(f"{self.path} has a T_BS that is no rotation and translation: restore the file")
        return T_body_sensor

    def camera(self) -> CameraFile:
        """The calibration of a camera.

        Raises:
            SequenceError: a key is missing or wrong, or the model of the lens is unknown.
        """
        name = str(self.keys.get("distortion_model", "none"))
        if name not in _MODELS or self.keys.get("camera_model", "pinhole") != "pinhole":
            raise SequenceError(
                f"{self.path} has camera_model {self.keys.get('camera_model')} and distortion_model {name}: known are "
                f"pinhole with {', '.join(_MODELS)}; undistort the images, or give --camera"
            )
        try:
            (width, height), (fx, fy, cx, cy) = self.keys["resolution"], self.keys["intrinsics"]
            distortion = [] if _MODELS[name] == "pinhole" else self.keys["distortion_coefficients"]
            fps = self.keys["rate_hz"]
        except (KeyError, TypeError, ValueError) as error:
            raise SequenceError(
                f"{self.path} needs resolution, intrinsics (4 numbers), distortion_coefficients and rate_hz: {error!r}"
            ) from error
        found = {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "fps": fps}
        return camera_of({**found, "model": _MODELS[name], "distortion": distortion}, str(self.path))


def _read_sensor(path: Path) -> _Sensor:
    try:
        text = read_text(path)
        # OpenCV's "%YAML:1.0" is no directive of YAML
        keys = parse_yaml(text.partition("\n")[2] if text.startswith("%") else text)
    except (OSError, UnicodeDecodeError, ErfsfmError) as error:
        raise SequenceError(f"cannot read {path}, the calibration of an EuRoC sensor: {error}") from error
    return _Sensor(path, keys if isinstance(keys, dict) else {})


def _true_poses(body: Path, stamps: FloatArray, camera: Path) -> FloatArray | None:
    """``T_any_camera`` at the images' stamps, NaN where unknown; None without ground truth.

    ``camera`` is the ``sensor.yaml`` that says where the camera sits.
    """
    folder = next((body / name for name in _TRUTH if (body / name / "data.csv").exists()), None)
    if folder is None:
        if (body / _POSITIONS).is_dir():
            logger.warning("%s has true positions without rotations: they are not used", body / _POSITIONS)
        return None
    table = folder / "data.csv"
    if not camera.exists():
        logger.warning(
            "the true poses in %s are not used: %s, which says where the camera sits, is missing", table, camera
        )
        return None
    truth = read_trajectory(table)
    sensor = folder / "sensor.yaml"
    T_body_sensor = _read_sensor(sensor).T_body_sensor() if sensor.exists() else np.eye(4)
    T_any_body = truth.T_world_camera @ se3.invert(T_body_sensor)
    return poses_near(T_any_body @ _read_sensor(camera).T_body_sensor(), truth.stamps, stamps, table)


def _read_index(table: Path) -> tuple[FloatArray, list[Path]]:
    """Stamps in seconds and image paths of ``data.csv``, good rows in the order of time."""
    try:
        lines = read_text(table).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SequenceError(f"cannot read {table}: {error}") from error
    bad = BadRows(table, SequenceError)
    rows = []
    for number, line in enumerate(lines, start=1):
        words = [word.strip() for word in line.split(",")]
        if len(words) > 1 and words[0].isdecimal():
            rows.append((number, int(words[0]) / _NANOSECONDS, table.parent / "data" / words[-1]))
        elif line.strip() and not line.startswith("#"):
            bad.add(number, f"{line!r} is not 'nanoseconds,file'")
    return bad.ordered(rows, "a row of nanoseconds and file for each image")


def _camera_folder(body: Path) -> Path | None:
    return next((body / name for name in _CAMERAS if (body / name / "data.csv").is_file()), None)


def _find(path: Path, asked: Asked) -> dict[str, Opener]:
    """``mav0`` itself, or the folder that has it."""
    body = next((place for place in (path / "mav0", path) if _camera_folder(place) is not None), None)
    return {} if body is None else {body.absolute().parent.name: partial(open_euroc, body, asked.camera)}


LOADER = Loader("EuRoC", "mav0/cam0/data.csv", _find)
