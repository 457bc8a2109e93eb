"""Settings of the front end: visual odometry, keyframes, gaps, step lengths, LiDAR, GPS and scale."""

from __future__ import annotations

import re
from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from erfsfm.common.config_tree import Section

ScaleMode = Literal["none", "camera-height", "lidar", "reference", "known", "gps"]


class VisualOdometryConfig(Section):
    """Relative poses from tracked corners, see ``frontend/visual/odometry.py``."""

    enabled: bool = Field(default=True, description="measure relative poses by image geometry")


class RoadConfig(Section):
    """Step lengths from the homography of the ground plane, see ``frontend/scale/road_homography.py``."""

    enabled: bool = Field(
        default=True, description="measure steps by the homography of the ground plane, in camera heights"
    )


class KeyframesConfig(Section):
    """Keyframes with bundle adjustment, see ``frontend/keyframes/odometry.py``."""

    use: Literal["auto", "always", "never"] = Field(
        default="auto",
        description="auto: unless a camera height is known or the first steps are a vehicle's; never: steps only",
    )


class GapsConfig(Section):
    """Gap interpolation over unusable frames, see ``frontend/gap_interpolation.py`` and ``frontend/image_gate.py``."""

    enabled: bool = Field(
        default=True,
        description="interpolate over unusable frames; false: measure them like other frames, which may end the run",
    )
    max_unread_frames: int = Field(
        default=30, ge=1, description="largest number of consecutive unreadable images; more end the run"
    )


class LidarConfig(Section):
    """LiDAR odometry, see ``frontend/lidar_odometry.py``. Without factors it is only compared."""

    factors: bool = Field(default=False, description="add kiss-icp's odometry to the pose graph")


class GpsConfig(Section):
    """A GPS track beside the images, see ``docs/gps.md``."""

    factors: bool = Field(default=True, description="add the positions to the pose graph; false: only compare them")
    sigma_m: float = Field(default=2.5, gt=0, description="sigma of a fix east and north where its HDOP is 1, metres")
    vertical_sigma_m: float = Field(default=5.0, gt=0, description="sigma of the height of a fix, metres")
    correlation_s: float = Field(default=10.0, ge=0, description="time for which fixes share their error, seconds")
    offset_s: float = Field(default=0.0, description="added to the stamps of the fixes, seconds")


class ScaleConfig(Section):
    """Metric scale, see ``frontend/scale/road_plane.py``."""

    mode: Literal["auto", "none", "camera-height", "lidar", "reference", "known", "gps"] = Field(
        default="auto", description="auto: camera-height where a height is known, else gps with --gps, else none"
    )
    known_m: float | None = Field(default=None, gt=0, description="mode known: distance of the two frames, metres")
    known_between: tuple[int | str, int | str] | None = Field(
        default=None, description="mode known: two frames of the run, or stamps in seconds such as 12.5s"
    )

    @field_validator("known_between")
    @classmethod
    def _frames_or_stamps(cls, ends: tuple[int | str, int | str] | None) -> tuple[int | str, int | str] | None:
        for end in ends or ():
            if (end < 0) if isinstance(end, int) else not re.fullmatch(r"-?\d+(\.\d*)?s", end):
                raise ValueError("two frame numbers, or stamps in seconds such as 12.5s")
        return ends

    @model_validator(mode="after")
    def _known_is_given(self) -> Self:
        if self.mode == "known" and (self.known_m is None or self.known_between is None):
            raise ValueError("known_m and known_between beside mode known")
        return self
