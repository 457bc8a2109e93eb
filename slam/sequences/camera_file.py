"""``camera.yaml``: the calibration of one's own camera."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal, Self

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from slam.errors import SequenceError
from slam.frames import Intrinsics

CAMERA_FILE = "camera.yaml"
_COEFFICIENTS = {"opencv": (4, 5, 8, 12, 14), "fisheye": (4,)}


class CameraFile(BaseModel):
    """The keys of ``camera.yaml``; (0, 0) is the centre of the top-left pixel."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    width: int = Field(gt=0, description="image width, pixels")
    height: int = Field(gt=0, description="image height, pixels")
    fx: float = Field(gt=0, description="focal length along u, pixels")
    fy: float = Field(gt=0, description="focal length along v, pixels")
    cx: float = Field(description="principal point u, pixels")
    cy: float = Field(description="principal point v, pixels")
    fps: float = Field(gt=0, description="frames a second")
    camera_height_m: float | Literal["unknown"] | None = Field(
        default=None, description="height of the camera above the road, metres, or unknown"
    )
    model: Literal["pinhole", "opencv", "fisheye"] = "pinhole"
    distortion: tuple[float, ...] = Field(
        default=(), description="opencv: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1..s4 [tx ty]]]]; fisheye: k1 k2 k3 k4"
    )
    source: str | None = Field(default=None, description="a note on where the numbers come from")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not isinstance(self.camera_height_m, str | None) and not self.camera_height_m > 0:
            raise ValueError(f"camera_height_m: must be greater than 0 or 'unknown', is {self.camera_height_m}")
        if not (0 < self.cx < self.width and 0 < self.cy < self.height):
            raise ValueError(f"cx, cy: ({self.cx:g}, {self.cy:g}) lies outside the {self.width}x{self.height} image")
        allowed = _COEFFICIENTS.get(self.model)
        if allowed is None and any(self.distortion):
            raise ValueError("distortion: needs model opencv or fisheye; a pinhole has none")
        if allowed is not None and len(self.distortion) not in allowed:
            counts = " or ".join(map(str, allowed))
            raise ValueError(f"distortion: model {self.model} has {counts} numbers, not {len(self.distortion)}")
        return self

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera matrix as written, before any undistortion."""
        return Intrinsics(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    @property
    def is_distorted(self) -> bool:
        """Whether images must be undistorted (a fisheye without coefficients still is)."""
        return self.model == "fisheye" or any(self.distortion)

    def height_or(self, default: float | None) -> float | None:
        """The camera's height in metres: None where unknown, ``default`` where the file does not say."""
        if self.camera_height_m is None:
            return default
        return None if isinstance(self.camera_height_m, str) else self.camera_height_m


def read_camera_file(path: Path) -> CameraFile:
    """Read and check a ``camera.yaml``.

    Raises:
        SequenceError: naming the file and the key that is missing, unknown or wrong.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise SequenceError(f"cannot read camera file {path}: {error}") from error
    except yaml.YAMLError as error:
        raise SequenceError(f"{path} is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        keys = ", ".join(name for name, item in CameraFile.model_fields.items() if item.is_required())
        raise SequenceError(f"{path} holds no keys: a camera file needs {keys}")
    try:
        return CameraFile.model_validate(content)
    except ValidationError as error:
        raise SequenceError(f"{path}: {_complaints(error)}") from error


def find_camera_file(explicit: Path | None, *folders: Path, wanted_by: str) -> CameraFile:
    """The camera file given by the user, or else the first ``camera.yaml`` found in ``folders``.

    Raises:
        SequenceError: if there is none, or it is wrong.
    """
    if explicit is not None:
        return read_explicit(explicit)
    for folder in folders:
        if (folder / CAMERA_FILE).is_file():
            return read_camera_file(folder / CAMERA_FILE)
    places = " and ".join(dict.fromkeys(str(folder) for folder in folders))
    raise SequenceError(
        f"no {CAMERA_FILE} for {wanted_by}: looked in {places}; put one there or give it with --camera "
        f"(width, height, fx, fy, cx, cy, fps)"
    )


def read_explicit(path: Path) -> CameraFile:
    """Read the camera file that the user named.

    Raises:
        SequenceError: if it does not exist or is wrong.
    """
    if not path.is_file():
        raise SequenceError(f"no camera file {path}: --camera needs a {CAMERA_FILE}")
    return read_camera_file(path)


def scaled_hint(camera: Intrinsics, width: int, height: int) -> str:
    """What a camera file would say for images of another size, as YAML on one line."""
    scaled = camera.resized(width, height)
    numbers = {name: getattr(scaled, name) for name in ("fx", "fy", "cx", "cy")}
    values = ", ".join(f"{name}: {value:.6g}" for name, value in numbers.items() if math.isfinite(value))
    return f"width: {width}, height: {height}, {values}"


def _complaints(error: ValidationError) -> str:
    """Every complaint of a validation, on one line, key first."""
    lines = []
    for item in error.errors():
        key = ".".join(str(part) for part in item["loc"][:1])
        if item["type"] == "missing":
            lines.append(f"key {key} is missing")
        elif item["type"] == "extra_forbidden":
            lines.append(f"key {key} is unknown (known: {', '.join(CameraFile.model_fields)})")
        elif not key:
            lines.append(str(item["ctx"]["error"]))
        else:
            lines.append(f"{key}: {item['msg'][0].lower() + item['msg'][1:]}, is {item['input']!r}")
    return "; ".join(dict.fromkeys(lines))
