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
    program = "COLMAP"
    keys_of: Callable[[Any], Keys] = _colmap
    if path.suffix != ".txt":
        mark = next((mark for mark in _PROGRAMS if isinstance(content, dict) and mark in content), None)
        if mark is None:
            return None
        program, keys_of = _PROGRAMS[mark]
    try:
        keys = keys_of(content)
        if not any(keys["distortion"]) and keys["model"] == "opencv":
            keys["model"] = "pinhole"
        if keys["model"] == "pinhole":
            keys["distortion"] = []
        return camera_of({"fps": fps, **keys, "source": f"a calibration of {program}"}, str(path))
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise DataError(f"{path} looks like a calibration of {program}, but lacks {error}") from error


def read_opencv_yaml(path: Path) -> Any:
    """The content of a YAML file that OpenCV may have written, whose first line and tags are none of YAML."""
    text = read_text(path)
    return parse_yaml(text.partition("\n")[2].replace("!!opencv-matrix", "") if text.startswith("%") else text)


def lens_model(name: str | None) -> Literal["pinhole", "opencv", "fisheye"]:
    """The model of ``camera.yaml`` of a lens as another program names it; ``DataError`` where it is unknown."""
    if name not in LENSES:
        raise DataError(f"the lens model {name} is unknown: known are {', '.join(filter(None, LENSES))}; give --camera")
    return LENSES[name]


def pinhole_keys(width: Any, height: Any, fx: Any, fy: Any, cx: Any, cy: Any, **more: Any) -> Keys:
    """The keys of ``camera.yaml`` for a camera, pixels, and ``more`` of them."""
    return {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **more}


def _kalibr(camera: Keys) -> Keys:
    """Of Kalibr's ``cam0`` or EuRoC's ``sensor.yaml``."""
    if camera.get("camera_model", "pinhole") != "pinhole":
        raise DataError(f"the camera_model {camera['camera_model']} is unknown: calibrate as pinhole")
    distortion = camera.get("distortion_coeffs", camera.get("distortion_coefficients", []))
    keys = pinhole_keys(*camera["resolution"], *camera["intrinsics"], distortion=distortion)
    rate = {"fps": camera["rate_hz"]} if "rate_hz" in camera else {}
    return {**keys, **rate, "model": lens_model(camera.get("distortion_model"))}


def _camera_info(content: Keys) -> Keys:
    fx, _, cx, _, fy, cy, *_ = content["camera_matrix"]["data"]
    keys = pinhole_keys(content["image_width"], content["image_height"], fx, fy, cx, cy)
    distortion = content.get("distortion_coefficients", {}).get("data", [])
    return {**keys, "model": lens_model(content.get("distortion_model")), "distortion": distortion}


def _orb_slam(content: Keys) -> Keys:
    prefix = "Camera1" if "Camera1.fx" in content else "Camera"
    focal = (content[f"{prefix}.{name}"] for name in ("fx", "fy", "cx", "cy"))
    model = lens_model(content.get("Camera.type", "PinHole"))
    names = ("k1", "k2", "k3", "k4") if model == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
    keys = pinhole_keys(content["Camera.width"], content["Camera.height"], *focal)
    keys |= {"fps": content["Camera.fps"]} if "Camera.fps" in content else {}
    return {**keys, "model": model, "distortion": [content.get(f"{prefix}.{name}", 0.0) for name in names]}


def _colmap(text: str) -> Keys:
    """Of the first row; COLMAP's (0.5, 0.5) is the centre of the first pixel."""
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    try:
        _, name, width, height, *words = rows[0]
        if name not in _COLMAP:
            raise DataError(f"COLMAP's camera model {name} is unknown: known are {', '.join(_COLMAP)}")
        places, coefficients, model = _COLMAP[name]
        values = [*map(float, words), 0.0]
        fx, fy, cx, cy = (values[place] for place in places)
        distortion = [values[place] for place in coefficients]
        return pinhole_keys(int(width), int(height), fx, fy, cx - 0.5, cy - 0.5, model=model, distortion=distortion)
    except (IndexError, ValueError) as error:
        raise ValueError("a row 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS...'") from error


_PROGRAMS: dict[str, tuple[str, Callable[[Keys], Keys]]] = {
    "cam0": ("Kalibr", lambda content: _kalibr(content["cam0"])),
    "T_BS": ("EuRoC", _kalibr),
    "camera_matrix": ("ROS", _camera_info),
    "Camera.fx": ("ORB-SLAM", _orb_slam),
    "Camera1.fx": ("ORB-SLAM", _orb_slam),
}
