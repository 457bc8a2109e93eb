"""Intrinsics of a pinhole camera: their change under a resize of the image, and a check for impossible values."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Self

from erfsfm.common.errors import DataError

logger = logging.getLogger(__name__)

# of the longer side of the image: a circular fisheye has 0.15, a telephoto lens of 3 degrees 20
FOCAL_RATIO_LIMITS = (0.1, 20.0)
# pixels: OpenCV resamples no longer sides; 64 million are more than the sensors of cameras have
_SIDE_LIMITS = (8, 32766)
MOST_PIXELS = 2**26
_CENTRE_TOLERANCE = 0.2  # of the image's size; the principal points of the KITTI cameras are within 0.05
_PIXEL_ASPECT_TOLERANCE = 0.1  # pixels of PAL video are 1.09 times as wide as they are high


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
    """Refuse an impossible camera, and warn once of an unlikely one; ``where`` it was read is for the message."""
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
        logger.warning("%s: %s; check that the calibration belongs to these images", where, "; ".join(doubts))
