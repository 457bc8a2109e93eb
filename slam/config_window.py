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
    keyframes: int = Field(default=10, ge=3, le=50, description="number of the last keyframes that are adjusted")
    max_corners: int = Field(default=500, ge=50, le=10000, description="largest number of corners of a keyframe")
    keyframe_parallax_ratio: float = Field(
        default=0.03, gt=0, lt=1, description="median parallax that asks for a keyframe, over the image width"
    )
