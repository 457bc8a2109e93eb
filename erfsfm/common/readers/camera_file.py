"""``camera.yaml``: the calibration of a user's own camera; intrinsics under a resize, and a check of their values."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from erfsfm.common.config_tree import first_problem, read_yaml
from erfsfm.common.errors import DataError, ErfsfmError

CAMERA_FILE = "camera.yaml"
CAMERA_WORD = re.compile(r"auto|(fov|height|fps)=(\d+\.?\d*)")  # of a camera on one line
logger = logging.getLogger(__name__)

HIGHEST_M = 100.0  # a camera that sees a road; heights in centimetres are beyond
# horizontal field of view, degrees, and relative sigma of the focal length of a camera of which nothing is known
UNKNOWN_FOV_DEG, UNKNOWN_FX_SIGMA = 65.0, 0.35
_USUAL_HEIGHTS_M = (0.1, 10.0)
_COEFFICIENTS = {"opencv": (4, 5, 8, 12, 14), "fisheye": (4,), "fov": (1,)}

# of the longer side of the image: a circular fisheye has 0.15, a telephoto lens of 3 degrees 20
FOCAL_RATIO_LIMITS = (0.1, 20.0)
# pixels: OpenCV resamples no longer sides; 64 million are more than the sensors of cameras have
_SIDE_LIMITS = (8, 32766)
MOST_PIXELS = 2**26
# of the image's size; the principal points of the KITTI cameras are within 0.05
_CENTRE_TOLERANCE = 0.2
_PIXEL_ASPECT_TOLERANCE = 0.1  # pixels of PAL video are 1.09 times as wide as they are high


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
    model: Literal["pinhole", "opencv", "fisheye", "fov"] = "pinhole"
    distortion: tuple[float, ...] = Field(
        default=(),
        description="opencv: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1..s4 [tx ty]]]]; fisheye: k1 k2 k3 k4; fov: the angle",
    )
    readout_ms: float = Field(
        default=0.0,
        ge=0,
        description="time from the first row of an image to the last, milliseconds (rolling shutter)",
    )
    depth_per_metre: float | None = Field(
        default=None, gt=0, description="value of one metre in the maps of depth/"
    )
    mask: str | None = Field(
        default=None,
        description="an image of the same size beside this file: white shows the world, black the bonnet or a caption",
    )
    fx_sigma: float = Field(
        default=0.0, ge=0, lt=1, description="relative sigma of fx; 0 of a calibration"
    )
    source: str | None = Field(default=None, description="a note on where the numbers come from")

    @model_validator(mode="after")
    def _check(self) -> Self:
        height_m = self.camera_height_m
        if not isinstance(height_m, str | None) and not 0 < height_m <= HIGHEST_M:
            raise ValueError(
                f"camera_height_m: must be metres above the road, greater than 0, to {HIGHEST_M:g}, or 'unknown', is "
                f"{height_m}"
            )
        if self.readout_ms > 1e3 / self.fps:
            raise ValueError(
                f"readout_ms: at most {1e3 / self.fps:g}, the time of a frame; is {self.readout_ms:g}"
            )
        problem = impossible(self.pinhole)
        if problem is not None:
            raise ValueError(problem)
        allowed = _COEFFICIENTS.get(self.model)
        if allowed is None and any(self.distortion):
            raise ValueError("distortion: needs model opencv, fisheye or fov; a pinhole has none")
        if allowed is not None and len(self.distortion) not in allowed:
            counts = " or ".join(map(str, allowed))
            raise ValueError(
                f"distortion: model {self.model} has {counts} numbers, not {len(self.distortion)}"
            )
        if self.model == "fov" and not 0 < self.distortion[0] < math.pi:
            raise ValueError(
                f"distortion: the angle of model fov lies between 0 and pi, is {self.distortion[0]:g}"
            )
        return self

    @property
    def pinhole(self) -> Pinhole:
        """The camera matrix as written, before any undistortion."""
        return Pinhole(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    @property
    def is_distorted(self) -> bool:
        """Whether images must be undistorted (a fisheye without coefficients still is)."""
        return self.model == "fisheye" or any(self.distortion)

    def height_or(self, default: float | None) -> float | None:
        """The camera's height in metres: None where unknown, ``default`` where the file has none."""
        if self.camera_height_m is None:
            return default
        return None if isinstance(self.camera_height_m, str) else self.camera_height_m


def is_line(given: Path) -> bool:
    """Whether the user wrote a camera on one line, not the name of a file."""
    return CAMERA_WORD.fullmatch(str(given).split(",")[0]) is not None


def is_auto(given: Path) -> bool:
    """Whether the user wants the camera to be found by its own images."""
    return is_line(given) and "fov=" not in str(given)


def read_camera_file(path: Path, own: Mapping[str, Any] | None = None) -> CameraFile:
    """Read and check a ``camera.yaml``; an unlikely camera is logged as a warning.

    Keys that it lacks are those of the recording's ``own`` camera, if any.

    Raises:
        DataError: the file cannot be read or holds no keys, a key is missing, unknown or wrong, or
            no
            camera is like that.
    """
    try:
        content = read_yaml(path)
    except ErfsfmError as error:
        raise DataError(str(error)) from error
    if not isinstance(content, dict):
        keys = ", ".join(
            name for name, item in CameraFile.model_fields.items() if item.is_required()
        )
        raise DataError(f"{path} holds no keys: a camera file needs {keys}")
    if isinstance(content.get("mask"), str):
        content["mask"] = str(path.parent / content["mask"])
    return camera_of({**(own or {}), **content}, str(path))


def camera_of(keys: dict[str, Any], where: str) -> CameraFile:
    """The camera of the keys of a camera file, found at ``where``; an unlikely camera is logged as a warning.

    Raises:
        DataError: naming the key that is missing, unknown or wrong.
    """
    try:
        camera = CameraFile.model_validate(keys)
    except ValidationError as error:
        raise DataError(f"{where}: {first_problem(error)}") from error
    require_plausible(camera.pinhole, where)
    height_m = camera.height_or(None)
    if height_m is not None and not _USUAL_HEIGHTS_M[0] <= height_m <= _USUAL_HEIGHTS_M[1]:
        logger.warning(
            "%s: camera_height_m is %g: check that it is the height above the road in metres",
            where,
            height_m,
        )
    return camera


@dataclass(frozen=True)
class Pinhole:
    """Size in pixels and intrinsics of one image without distortion; (0, 0) is the centre of the top-left pixel."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def of(cls, camera: Pinhole) -> Self:
        """The same camera as this class."""
        return cls(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)

    def resized(self, width: int, height: int) -> Self:
        """The camera of the image resized to ``width x height``, half-pixel exact: ``c' = (c + 0.5) s - 0.5``."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )


def impossible(camera: Pinhole) -> str | None:
    """Why a camera cannot be: size or focal length out of bounds, principal point outside the image; else None."""
    size = f"{camera.width}x{camera.height}"
    shortest, longest = _SIDE_LIMITS
    sides = camera.width, camera.height
    if min(sides) < shortest or max(sides) > longest or camera.width * camera.height > MOST_PIXELS:
        return (
            f"width, height: images of {size} are none of a camera: wanted {shortest} to {longest} pixels a side, and "
            f"{MOST_PIXELS:,} at most; resize the images"
        )
    least, most = FOCAL_RATIO_LIMITS
    longer = max(camera.width, camera.height)
    for name, focal in (("fx", camera.fx), ("fy", camera.fy)):
        if not least * longer <= focal <= most * longer:
            return (
                f"{name}: {focal:g} is no focal length in pixels of {size} images: from a fisheye to a telephoto lens "
                f"it lies between {least * longer:g} and {most * longer:g}"
            )
    if not (0 < camera.cx < camera.width and 0 < camera.cy < camera.height):
        return f"cx, cy: ({camera.cx:g}, {camera.cy:g}) lies outside the {size} image"
    return None


def require_plausible(camera: Pinhole, where: str) -> None:
    """Refuse an impossible camera, and warn once of an unlikely one; ``where`` it was read is for the message.

    Raises:
        DataError: no camera has such a size, focal length or principal point.
    """
    problem = impossible(camera)
    if problem is not None:
        raise DataError(f"{where}: {problem}")
    doubts = []
    offset = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
    if offset > _CENTRE_TOLERANCE:
        doubts.append(
            f"the principal point ({camera.cx:g}, {camera.cy:g}) is far from the middle of "
            f"{camera.width}x{camera.height} images"
        )
    if abs(camera.fx / camera.fy - 1) > _PIXEL_ASPECT_TOLERANCE:
        doubts.append(f"fx : fy is {camera.fx / camera.fy:.2f}, so pixels are not square")
    if doubts:
        logger.warning(
            "%s: %s; check that the calibration belongs to these images", where, "; ".join(doubts)
        )
