"""Settings of keyframes and their bundle adjustment."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from erfsfm.config_tree import Section


class WindowConfig(Section):
    """Keyframes with bundle adjustment, see ``frontend/window/odometry.py``."""

    use: Literal["auto", "always", "never"] = Field(
        default="auto",
        description="auto: unless a camera height is known or the first steps are a vehicle's; never: steps alone",
    )
    decision_steps: int = Field(default=30, ge=2, description="triangulated steps after which auto decides")
    vehicle_scatter_deg: float = Field(
        default=10.0, gt=0, lt=90, description="median angle of a vehicle's steps to their usual direction, degrees"
    )
    keyframes: int = Field(default=10, ge=3, le=50, description="number of the last keyframes that are adjusted")
    max_corners: int = Field(default=500, ge=50, le=10000, description="largest number of corners of a keyframe")
    corner_quality: float = Field(
        default=0.002, gt=0, lt=1, description="least corner strength over that of the strongest corner"
    )
    corner_spacing_px: float = Field(default=12.0, ge=1, description="least distance between corners, pixels")
    window_px: int = Field(default=15, ge=5, le=63, description="side of the Lucas-Kanade window, pixels")
    pyramid_levels: int = Field(default=3, ge=0, le=8, description="image pyramid levels above the full image")
    forward_backward_px: float = Field(default=0.7, gt=0, description="largest forward-backward tracking error, pixels")
    start_parallax_ratio: float = Field(
        default=0.0125, gt=0, lt=1, description="least median parallax of the first two keyframes, over the image width"
    )
    keyframe_parallax_ratio: float = Field(
        default=0.03, gt=0, lt=1, description="median parallax that asks for a keyframe, over the image width"
    )
    keyframe_tracks_ratio: float = Field(
        default=0.35, gt=0, lt=1, description="ratio of a keyframe's corners still tracked that asks for another"
    )
    min_angle_deg: float = Field(default=0.6, gt=0, lt=90, description="least angle between rays of a point, degrees")
    min_points: int = Field(default=20, ge=8, description="least number of points that give a camera its pose")
    inlier_px: float = Field(default=3.0, gt=0, description="residual of an inlier of a camera's pose, pixels")
    outlier_px: float = Field(default=5.0, gt=0, description="residual of a sighting that is taken out, pixels")
    pixel_sigma: float = Field(default=0.7, gt=0, description="sigma of a corner, pixels")
    huber_sigmas: float = Field(default=1.5, gt=0, description="residual from which a sighting weighs less, sigmas")
    iterations: int = Field(default=12, ge=1, description="most iterations of a bundle adjustment")
    tolerance: float = Field(default=1e-4, gt=0, description="relative fall of the cost at which it ends")
    max_lost_frames: int = Field(default=10, ge=1, description="frames without a pose after which a new map is begun")
    relative_sigma: float = Field(
        default=0.02, gt=0, description="least translation sigma of a factor over the length of its step"
    )
    rotation_sigma_deg: float = Field(default=0.1, gt=0, description="least rotation sigma of a factor, degrees")
