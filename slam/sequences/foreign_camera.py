"""Calibrations of other programs: Kalibr, EuRoC, ROS's camera_info YAML, ORB-SLAM's settings, COLMAP's cameras.txt."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from erfsfm.common.config_tree import parse_yaml
from erfsfm.common.errors import DataError, ErfsfmError
from erfsfm.common.files import read_text
from erfsfm.common.readers.camera_file import CameraFile, camera_of

Keys = dict[str, Any]

# names of a lens by other programs, and the model of camera.yaml
LENSES: dict[str | None, Literal["pinhole", "opencv", "fisheye"]] = {
    **dict.fromkeys(("plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "PinHole"), "opencv"),
    **dict.fromkeys(("equidistant", "fisheye", "KannalaBrandt8"), "fisheye"),
    **dict.fromkeys(("none", "None", "", None, "Rectified"), "pinhole"),
}
# COLMAP: places of fx, fy, cx, cy among the parameters, those of k1 k2 p1 p2 k3 ... (-1: zero), and the model
_COLMAP: dict[str, tuple[tuple[int, ...], tuple[int, ...], str]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), (), "pinhole"),
    "PINHOLE": ((0, 1, 2, 3), (), "pinhole"),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3, -1, -1, -1), "opencv"),
    "RADIAL": ((0, 0, 1, 2), (3, 4, -1, -1), "opencv"),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7), "opencv"),
    "OPENCV_FISHEYE": ((0, 1, 2, 3), (4, 5, 6, 7), "fisheye"),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11), "opencv"),
}


def read_foreign_camera(path: Path, fps: float) -> CameraFile | None:
    """The camera of another program's file; None where it looks like none of them.

    Args:
        path: of the file; of several cameras the first is taken.
        fps: frames a second, for files without a rate.

    Raises:
        DataError: it is such a file, but a number is missing or wrong, or its lens is unknown.
    """
    try:
        content = read_text(path) if path.suffix == ".txt" else read_opencv_yaml(path)
    except (OSError, UnicodeDecodeError, ErfsfmError):
        return None  # for the reader of camera.yaml to say what is wrong
    if path.suffix == ".txt":
        try:
            return camera_of(_with_source(_colmap(content), "COLMAP", fps), str(path))
        except (IndexError, ValueError, StopIteration) as error:
            raise DataError(f"{path} has no row 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS...' of COLMAP: {error}") from error
    if not isinstance(content, dict):
        return None
    for mark, (program, keys_of) in _PROGRAMS.items():
        if mark in content:
            try:
                return camera_of(_with_source(keys_of(content), program, fps), str(path))
            except (KeyError, IndexError, TypeError, ValueError) as error:
                raise DataError(f"{path} looks like a calibration of {program}, but lacks {error}") from error
    return None


def read_opencv_yaml(path: Path) -> Any:
    """The content of a YAML file that OpenCV may have written, whose first line and tags are none of YAML.

    Raises:
        OSError, UnicodeDecodeError, ErfsfmError: it cannot be read.
    """
    text = read_text(path)
    return parse_yaml(text.partition("\n")[2].replace("!!opencv-matrix", "") if text.startswith("%") else text)


def _with_source(keys: Keys, program: str, fps: float) -> Keys:
    if keys["model"] == "pinhole" or (keys["model"] == "opencv" and not any(keys["distortion"])):
        keys |= {"model": "pinhole", "distortion": []}
    return {"fps": fps, **keys, "source": f"a calibration of {program}"}


def lens_model(name: str | None) -> Literal["pinhole", "opencv", "fisheye"]:
    """The model of ``camera.yaml`` of a lens as another program names it; ``DataError`` where it is unknown."""
    if name not in LENSES:
        raise DataError(f"the lens model {name} is unknown: known are {', '.join(filter(None, LENSES))}; give --camera")
    return LENSES[name]


def _pinhole(width: Any, height: Any, fx: Any, fy: Any, cx: Any, cy: Any) -> Keys:
    return {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}


def _kalibr(content: Keys) -> Keys:
    camera = content["cam0"]
    if camera["camera_model"] != "pinhole":
        raise DataError(f"Kalibr's camera_model {camera['camera_model']} is unknown: calibrate as pinhole")
    keys = _pinhole(*camera["resolution"], *camera["intrinsics"])
    return {
        **keys,
        "model": lens_model(camera.get("distortion_model")),
        "distortion": camera.get("distortion_coeffs", []),
    }


def _euroc(content: Keys) -> Keys:
    if content.get("camera_model", "pinhole") != "pinhole":
        raise DataError(f"EuRoC's camera_model {content['camera_model']} is unknown: undistort the images")
    keys = _pinhole(*content["resolution"], *content["intrinsics"])
    lens = {
        "model": lens_model(content.get("distortion_model")),
        "distortion": content.get("distortion_coefficients", []),
    }
    return {**keys, **lens, **({"fps": content["rate_hz"]} if "rate_hz" in content else {})}


def _camera_info(content: Keys) -> Keys:
    fx, _, cx, _, fy, cy, *_ = content["camera_matrix"]["data"]
    keys = _pinhole(content["image_width"], content["image_height"], fx, fy, cx, cy)
    distortion = content.get("distortion_coefficients", {}).get("data", [])
    return {**keys, "model": lens_model(content.get("distortion_model")), "distortion": distortion}


def _orb_slam(content: Keys) -> Keys:
    prefix = "Camera1" if "Camera1.fx" in content else "Camera"
    focal = (content[f"{prefix}.{name}"] for name in ("fx", "fy", "cx", "cy"))
    model = lens_model(content.get("Camera.type", "PinHole"))
    names = ("k1", "k2", "k3", "k4") if model == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
    keys = _pinhole(content["Camera.width"], content["Camera.height"], *focal)
    keys |= {"fps": content["Camera.fps"]} if "Camera.fps" in content else {}
    return {**keys, "model": model, "distortion": [content.get(f"{prefix}.{name}", 0.0) for name in names]}


def _colmap(text: str) -> Keys:
    """Of the first row; COLMAP's (0.5, 0.5) is the centre of the first pixel."""
    row = next(line.split() for line in text.splitlines() if line.strip() and not line.startswith("#"))
    _, name, width, height, *words = row
    if name not in _COLMAP:
        raise DataError(f"COLMAP's camera model {name} is unknown: known are {', '.join(_COLMAP)}")
    values = [*map(float, words), 0.0]
    places, coefficients, model = _COLMAP[name]
    fx, fy, cx, cy = (values[place] for place in places)
    keys = _pinhole(int(width), int(height), fx, fy, cx - 0.5, cy - 0.5)
    return {**keys, "model": model, "distortion": [values[place] for place in coefficients]}


_PROGRAMS: dict[str, tuple[str, Callable[[Keys], Keys]]] = {
    "cam0": ("Kalibr", _kalibr),
    "T_BS": ("EuRoC", _euroc),
    "camera_matrix": ("ROS", _camera_info),
    "Camera.fx": ("ORB-SLAM", _orb_slam),
    "Camera1.fx": ("ORB-SLAM", _orb_slam),
}
