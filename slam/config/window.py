"""Settings of keyframes and their bundle adjustment."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from erfsfm.common.config_tree import Section


class WindowConfig(Section):
    """Keyframes with bundle adjustment, see ``frontend/window/odometry.py``."""

    use: Literal["auto", "always", "never"] = Field(
        default="auto",
        description="auto: unless a camera height is known or the first steps are a vehicle's; never: steps only",
    )
    max_corners: int = Field(default=500, ge=50, le=10000, description="largest number of corners of a keyframe")
