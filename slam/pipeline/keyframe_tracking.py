"""Whether a drive is measured by keyframes and bundle adjustment, and its poses by them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

import numpy as np

from slam.config import SlamConfig, WindowConfig
from slam.frames import DepthMap, Frame, Intrinsics
from slam.frontend.window.odometry import Segment, WindowOdometry, WindowState
from slam.frontend.window.relative_poses import WindowPoses, window_poses
from slam.pipeline.observations import Observations


def decided(config: SlamConfig, camera_height_m: float | None) -> SlamConfig:
    """The configuration with ``window.use`` decided where a camera height is known, which says that there is a road.

    Lengths from the road do not enter the window yet, and on roads they matter more than its longer baselines.
    """
    if config.window.use != "auto" or camera_height_m is None:
        return config
    return config.model_copy(update={"window": config.window.model_copy(update={"use": "never"})})


class KeyframeTracking:
    """Tracks keyframes beside the steps, until those are of a vehicle."""

    def __init__(self, config: WindowConfig, intrinsics: Intrinsics, seed: int, state: WindowState | None) -> None:
        """Prepare for the first frame, or resume; a state of None is of a drive that is measured by steps alone."""
        self._config, self._intrinsics, self._seed = config, intrinsics, seed
        self._odometry: WindowOdometry | None = None
        if config.use != "never" and state is not None:
            self._odometry = WindowOdometry(config, intrinsics, seed, state)

    def state(self) -> WindowState | None:
        """The state to resume from."""
        return None if self._odometry is None else self._odometry.state()

    def add(self, frame: Frame, depth: DepthMap) -> None:
        """The next usable frame with its learned depth ``(H, W)``."""
        if self._odometry is not None:
            self._odometry.add(frame, depth)

    def decide(self, seen: Observations) -> None:
        """End the tracking where the first steps are those of a vehicle."""
        if self._odometry is not None and self._config.use == "auto" and is_vehicle(seen, self._config):
            self._odometry = None

    def maps(self, seen: Observations) -> tuple[Segment, ...]:
        """All maps so far; none of a vehicle, nor before that is decided."""
        undecided = self._config.use == "auto" and is_vehicle(seen, self._config) is None
        if self._odometry is None or undecided:
            return ()
        return tuple(segment for segment in self._odometry.state().segments if segment.started)

    def poses(self, maps: Sequence[Segment]) -> WindowPoses:
        """Relative poses of all frames of some maps."""
        return window_poses(maps, self._intrinsics, self._config, self._seed)


def is_vehicle(seen: Observations, config: WindowConfig) -> bool | None:
    """Whether the first triangulated steps all go the same way, as seen from the camera; None while they are few."""
    triangulated = (motion for motion in seen.motions if motion.triangulated is not None)
    first = [motion.relative_pose.T_from_to[:3, 3] for motion in islice(triangulated, config.decision_steps)]
    if len(first) < config.decision_steps:
        return None
    directions = np.array(first) / np.linalg.norm(first, axis=1, keepdims=True)
    usual = np.median(directions, axis=0)
    cosine = directions @ usual / max(float(np.linalg.norm(usual)), 1e-9)
    return float(np.median(cosine)) > float(np.cos(np.deg2rad(config.vehicle_scatter_deg)))
