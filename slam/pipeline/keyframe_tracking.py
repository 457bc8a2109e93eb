"""Whether a drive is measured by keyframes and bundle adjustment, and its poses by them."""

from __future__ import annotations

from slam.config import SlamConfig, WindowConfig
from slam.frames import DepthMap, Frame, Intrinsics
from slam.frontend.window.odometry import WindowOdometry, WindowState
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
    """Tracks keyframes beside the steps, until those show a road."""

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
        """End the tracking where the steps so far show a road."""
        if len(seen.roads) >= self._config.decision_frames and self._is_on_road(seen):
            self._odometry = None

    def poses(self, seen: Observations) -> WindowPoses:
        """Relative poses of all frames so far; none on a road."""
        if self._odometry is None or self._is_on_road(seen):
            return WindowPoses()
        return window_poses(self._odometry.state(), self._intrinsics, self._config, self._seed)

    def _is_on_road(self, seen: Observations) -> bool:
        if self._config.use == "always":
            return False
        return len(seen.road_steps) > self._config.max_road_ratio * max(len(seen.motions), 1)
