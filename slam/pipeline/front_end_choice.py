"""Which front end measures a drive, steps from frame to frame or keyframes, and what keyframes give it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from itertools import islice
from typing import Literal

import numpy as np

from erfsfm.common.processes import opencv_threads, usable_cores
from slam.config.sections import KeyframesConfig, LoopsConfig
from slam.frames import DepthMap, Frame, Intrinsics, TrackingEvent
from slam.frontend.drive import LAST_STEPS, Drive
from slam.frontend.keyframes.learned_units import learned_unit
from slam.frontend.keyframes.local_map import LocalMap
from slam.frontend.keyframes.odometry import KeyframeOdometry
from slam.frontend.keyframes.submaps import parts_of
from slam.geometry.se3 import FloatArray, invert
from slam.runtime.errors import Failed

FrontEnd = Literal["steps", "both", "keyframes"]

# looked back for the frame before, and keyframes that give the unit
_FRAMES, _KEYFRAMES = 40, 20
# triangulated steps after which auto decides, if it is clear, or however that is
_CLEAR_STEPS, _MOST_STEPS = 10, 30
_VEHICLE_SCATTER_DEG = 10.0  # median angle of a vehicle's steps to their usual direction, degrees
# of a camera that is carried: a vehicle's first steps scatter by 2 degrees
_CLEAR_SCATTER_DEG = 5.0
# camera heights a second: a car at 9 km/h; a robot, a drone and a walker have less
_VEHICLE_SPEED = 1.5


def choose(config: KeyframesConfig, camera_height_m: float | None, drive: Drive) -> FrontEnd:
    """What measures a drive: both, until its first steps show whether the camera is on a vehicle.

    A known camera height says that there is a road. Lengths from the road do not enter the map of keyframes yet, and on
    roads they matter more than its longer baselines.

    Args:
        config: the settings of keyframes.
        camera_height_m: above the road, metres; None where unknown.
        drive: the measurements so far.
    """
    if config.use == "always":
        return "keyframes"
    if config.use == "never" or camera_height_m is not None:
        return "steps"
    is_on_vehicle = _is_on_vehicle(drive)
    if is_on_vehicle is None:
        return "both"
    return "steps" if is_on_vehicle else "keyframes"


class KeyframeTracking:
    """Tracks keyframes, for as long as steps alone are not chosen."""

    def __init__(
        self,
        config: KeyframesConfig,
        loops: LoopsConfig,
        intrinsics: Intrinsics,
        seed: int,
        camera_height_m: float | None = None,
        on_keyframe: Callable[[Frame], None] = lambda frame: None,
    ) -> None:
        """Prepare for the first frame.

        Args:
            config: the settings of keyframes.
            loops: those of loops; where these are enabled, the camera is sought again after it was
                lost.
            intrinsics: of all images.
            seed: of all RANSAC draws.
            camera_height_m: above the road, metres; None where unknown.
            on_keyframe: is told of a keyframe before it is adjusted.
        """
        self._config, self._intrinsics, self._camera_height_m = config, intrinsics, camera_height_m
        self._front_end: FrontEnd = "both"
        self._cores = ExitStack()
        # the networks, which predict little for keyframes, leave their core to optical flow
        self._cores.enter_context(opencv_threads(usable_cores()))
        self._odometry: KeyframeOdometry | None = KeyframeOdometry(
            intrinsics, seed, on_keyframe, loops.enabled
        )
        self.choose(Drive())

    @property
    def _measuring(self) -> KeyframeOdometry | None:
        """The keyframes where they measure the drive: not before the choice, nor on a vehicle."""
        return self._odometry if self._front_end == "keyframes" else None

    @property
    def events(self) -> Sequence[TrackingEvent]:
        """What became of the maps so far."""
        return () if self._odometry is None else self._odometry.events

    def follow(self, frame: Frame) -> None:
        """Track the next usable frame."""
        if self._odometry is not None:
            self._odometry.follow(frame)

    def learn(self, frame: Frame, depth: DepthMap) -> None:
        """Learned depth ``(H, W)`` of the frame that was followed last."""
        if self._odometry is not None:
            self._odometry.learn(frame, depth)

    def choose(self, drive: Drive) -> None:
        """Choose what measures the frames that follow, until that is one of both."""
        if self._front_end == "both":
            self._front_end = choose(self._config, self._camera_height_m, drive)
        if self._front_end == "steps":
            self._odometry = None
            self.close()

    def close(self) -> None:
        """Give the cores back that optical flow had."""
        self._cores.close()

    def measures(self, drive: Drive, index: int) -> bool:
        """Whether keyframes alone measure the motion to one of the last frames.

        A step measures it by a gap or a lost camera, and before the choice.
        """
        if self._measuring is None:
            return False
        is_usable = {index - 1, index}.isdisjoint(list(drive.unusable)[-LAST_STEPS:])
        return (
            is_usable
            and drive.last_step(index) is None
            and self._measuring.locates(index - 1, index)
        )

    def step(self, index: int) -> tuple[int, FloatArray] | None:
        """The last located frame before this one, and ``T_before_frame`` unscaled; None where it has no pose."""
        if self._measuring is None or not self._measuring.segments:
            return None
        segment = self._measuring.segments[-1]
        located: list[tuple[int, FloatArray]] = []
        for each in segment.frames[-_FRAMES:]:
            if each.index <= index and each.T_camera_world is not None:
                located.append((each.index, each.T_camera_world))
        if len(located) < 2 or located[-1][0] != index:
            return None
        (before, T_before_map), (_, T_frame_map) = located[-2:]
        T_before_frame = T_before_map @ invert(T_frame_map)
        T_before_frame[:3, 3] *= learned_unit(
            LocalMap(segment.keyframes[-_KEYFRAMES:], segment.points)
        )
        return before, T_before_frame

    def maps(self, drive: Drive) -> list[LocalMap]:
        """All parts of maps so far, each in one unit; none of a vehicle, nor before the choice."""
        self.choose(drive)
        if self._measuring is None:
            return []
        maps = [each.copy() for each in self._measuring.segments if each.started]
        parts: list[LocalMap] = []
        for each in maps:
            parts += parts_of(each, self._intrinsics)
        return parts


def _is_on_vehicle(drive: Drive) -> bool | None:
    """Whether the first triangulated steps all go the same way, as seen from the camera, at the speed of a vehicle.

    None while they are few. Without a road nothing has the speed of a vehicle; a vehicle that starts is slow.
    """
    first = list(
        islice((motion for motion in drive.motions if motion.is_triangulated), _MOST_STEPS)
    )
    if len(first) < _CLEAR_STEPS:
        return None
    heights = [road for road in drive.roads if not isinstance(road, Failed)]
    speeds = [motion.length_unscaled / motion.seconds for motion in first]
    is_fast = bool(heights) and bool(np.median(speeds) >= _VEHICLE_SPEED * np.median(heights))
    steps = np.array([motion.relative_pose.T_from_to[:3, 3] for motion in first])
    directions = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    usual = np.median(directions, axis=0)
    cosine = directions @ usual / max(float(np.linalg.norm(usual)), 1e-9)
    scatter_deg = float(np.rad2deg(np.arccos(np.clip(np.median(cosine), -1.0, 1.0))))
    is_clear = is_fast or scatter_deg > _CLEAR_SCATTER_DEG
    if len(first) < _MOST_STEPS and not is_clear:
        return None
    return is_fast and scatter_deg < _VEHICLE_SCATTER_DEG
