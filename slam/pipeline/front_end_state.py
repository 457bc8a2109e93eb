"""The state of the pass over the frames, from which a drive goes on."""

from __future__ import annotations

from dataclasses import dataclass

from slam.frames import DepthMap, Frame
from slam.frontend.drive import Drive
from slam.frontend.image_gate import GateState
from slam.frontend.keyframes.odometry import KeyframeOdometryState
from slam.frontend.visual.odometry import OdometryState
from slam.geometry.se3 import FloatArray


@dataclass(frozen=True)
class RecentFrame:
    """A frame to measure steps from, its depth ``(H, W)``, None until that is needed, and camera height, unscaled."""

    frame: Frame
    depth: DepthMap | None
    height: float | None


@dataclass(frozen=True)
class FrontEndState:
    """A snapshot after a frame; ``keyframes`` is None where the drive is measured by steps alone."""

    drive: Drive
    gate: GateState
    odometry: OdometryState
    keyframes: KeyframeOdometryState | None
    road_directions: tuple[FloatArray, ...]
    snippet_frames: tuple[Frame, ...]
    recent: tuple[RecentFrame, ...]
    unread: int
    depth_index: int
