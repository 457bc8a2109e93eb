"""The door of both front ends: steps from frame to frame, and keyframes; which of them measures a drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from itertools import islice

import numpy as np

from erfsfm.common.processes import opencv_threads, usable_cores
from slam.config.sections import KeyframesConfig, SlamConfig
from slam.frames import DepthMap, Frame, Intrinsics
from slam.frontend.keyframes.local_map import LocalMap
from slam.frontend.keyframes.odometry import KeyframeOdometry
from slam.frontend.keyframes.submaps import parts_of
from slam.frontend.keyframes.units import learned_unit
from slam.frontend.measured import LAST_STEPS, FrontEnd, Measured
from slam.frontend.visual.step_tracker import Beside, Seen, StepTracker
from slam.geometry.se3 import FloatArray, in_unit, invert, length_of, normalised
from slam.runtime.stopwatch import Stopwatch

# looked back for the frame before, and keyframes that give the unit
_FRAMES, _KEYFRAMES = 40, 20
# triangulated steps after which auto decides, if it is clear, or however that is
_CLEAR_STEPS, _MOST_STEPS = 10, 30
# least share of images that see a road: 0.6 to 1 of drives, 0.2 of a camera that turns in a room
_ROAD_SHARE = 1.0 / 3.0
_VEHICLE_SCATTER_DEG = 10.0  # median angle of a vehicle's steps to their usual direction, degrees
# of a camera that is carried: a vehicle's first steps scatter by 2 degrees
_CLEAR_SCATTER_DEG = 5.0
# camera heights a second: a car at 9 km/h; a robot, a drone and a walker have less
_VEHICLE_SPEED = 1.5


class MotionTracker:
    """Measures the camera's motion: by both front ends, until its first steps show which one is to go on."""

    def __init__(
        self,
        config: SlamConfig,
        intrinsics: Intrinsics,
        measured: Measured,
        stopwatch: Stopwatch,
        seen: Callable[[Frame], Seen],
        on_keyframe: Callable[[Frame], None],
        seed: int = 0,
        camera_height_m: float | None = None,
    ) -> None:
        """Prepare for the first frame.

        Args:
            config: all settings.
            intrinsics: of all images.
            measured: is given what is measured.
            stopwatch: that times both front ends.
            seen: gives the depth of a recent frame.
            on_keyframe: is told of a keyframe before it is adjusted.
            seed: of all RANSAC draws.
            camera_height_m: above the road, metres; None where unknown.
        """
        self._config, self._intrinsics, self._camera_height_m = config, intrinsics, camera_height_m
        self._measured, self._stopwatch = measured, stopwatch
        self._steps = StepTracker(intrinsics, seed, measured, seen)
        self.step_odometry = self._steps.odometry  # knows the error of learned depth
        self._cores = ExitStack()
        # the networks, which predict little for keyframes, leave their core to optical flow
        self._cores.enter_context(opencv_threads(usable_cores()))
        # a lost camera is sought again where loops are
        self._keyframes: KeyframeOdometry | None = KeyframeOdometry(
            intrinsics, seed, on_keyframe, config.loops.enabled
        )
        self._chosen: FrontEnd | None = None
        self.choose()

    @property
    def _alone(self) -> KeyframeOdometry | None:
        """The keyframes where they measure the drive: not before the choice, nor on a vehicle."""
        return self._keyframes if self._chosen is FrontEnd.KEYFRAMES else None

    def add(self, recent: Sequence[Frame], current: Frame) -> list[Beside]:
        """Measure the motion to the next usable frame; what is to be measured beside it.

        Args:
            recent: usable frames before it, without a gap.
            current: the frame.
        """
        with self._stopwatch.stage("keyframes"):
            if self._keyframes is not None:
                self._keyframes.follow(current)
        if not self._config.visual_odometry.enabled or self.keyframes_alone(current.index):
            recent = ()
        with self._stopwatch.stage("geometry"):
            return self._steps.add(recent, current)

    def learn(self, frame: Frame, depth: DepthMap) -> None:
        """Learned depth ``(H, W)`` of the frame that was added last."""
        if self._keyframes is not None:
            self._keyframes.learn(frame, depth)

    def choose(self) -> None:
        """Choose what measures the frames that follow, as soon as that is clear."""
        if self._chosen is None:
            self._chosen = choose(self._config.keyframes, self._camera_height_m, self._measured)
        if self._chosen is FrontEnd.STEPS:
            self._keyframes = None
            self.close()

    def keyframes_alone(self, index: int) -> bool:
        """Whether keyframes alone measure the motion to one of the last frames.

        A step measures it by a gap or a lost camera, and before the choice.
        """
        if self._alone is None or self._measured.last_step(index) is not None:
            return False
        is_usable = {index - 1, index}.isdisjoint(list(self._measured.unusable)[-LAST_STEPS:])
        return is_usable and self._alone.locates(index - 1, index)

    def pose(self, index: int) -> tuple[int, FloatArray] | None:
        """The located frame before one of the last, and ``T_before_frame`` unscaled; None where no map has it."""
        if self._alone is None or not self._alone.segments:
            return None
        segment = self._alone.segments[-1]
        located = [
            each
            for each in segment.frames[-_FRAMES:]
            if each.index <= index and each.T_camera_keyframe is not None
        ]
        if len(located) < 2 or located[-1].index != index:
            return None
        T_before_map, T_frame_map = map(segment.T_camera_world, located[-2:])
        unit = learned_unit(LocalMap(segment.keyframes[-_KEYFRAMES:], segment.points))
        return located[-2].index, in_unit(T_before_map @ invert(T_frame_map), unit)

    def finish(self) -> Measured:
        """All that was measured so far, which stays while more frames follow.

        Maps are cut into parts of one unit each; there are none of a vehicle, nor before the choice.
        """
        self.choose()
        measured = self._measured.copy()
        measured.depth_error = self.step_odometry.depth_error
        measured.corners = self.step_odometry.corners.seen(2.0 / self._intrinsics.width)
        if self._keyframes is not None:
            measured.events = list(self._keyframes.events)
        parts: list[LocalMap] = []
        for segment in () if self._alone is None else self._alone.segments:
            if segment.started:
                parts += parts_of(segment.copy(), self._intrinsics)
        measured.maps = parts
        return measured

    def close(self) -> None:
        """Give the cores back that optical flow had."""
        self._cores.close()


def choose(
    config: KeyframesConfig, camera_height_m: float | None, measured: Measured
) -> FrontEnd | None:
    """What measures a drive; None until its first steps show whether the camera is on a vehicle.

    A known camera height says that there is a road. Lengths from the road do not enter the map of keyframes yet, and on
    roads they matter more than its longer baselines.

    Args:
        config: the settings of keyframes.
        camera_height_m: above the road, metres; None where unknown.
        measured: the drive so far.
    """
    if config.use == "always":
        return FrontEnd.KEYFRAMES
    if config.use == "never" or camera_height_m is not None:
        return FrontEnd.STEPS
    is_on_vehicle = _is_on_vehicle(measured)
    if is_on_vehicle is None:
        return None
    return FrontEnd.STEPS if is_on_vehicle else FrontEnd.KEYFRAMES


def _is_on_vehicle(measured: Measured) -> bool | None:
    """Whether the first triangulated steps all go the same way, as seen from the camera, at the speed of a vehicle.

    None while they are few. Without a road in many images nothing has the speed of a vehicle; a vehicle that starts is
    slow.
    """
    first = list(
        islice(
            (motion for motion in measured.steps.values() if motion.is_triangulated), _MOST_STEPS
        )
    )
    if len(first) < _CLEAR_STEPS:
        return None
    heights = [road for road in measured.roads if road is not None]
    speeds = [motion.length_unscaled / motion.seconds for motion in first]
    is_on_road = len(heights) > _ROAD_SHARE * len(measured.roads)
    is_fast = is_on_road and bool(np.median(speeds) >= _VEHICLE_SPEED * np.median(heights))
    steps = np.array([motion.relative_pose.T_from_to[:3, 3] for motion in first])
    directions = normalised(steps)
    usual = np.median(directions, axis=0)
    cosine = directions @ usual / max(length_of(usual), 1e-9)
    scatter_deg = float(np.rad2deg(np.arccos(np.clip(np.median(cosine), -1.0, 1.0))))
    is_clear = is_fast or scatter_deg > _CLEAR_SCATTER_DEG
    if len(first) < _MOST_STEPS and not is_clear:
        return None
    return is_fast and scatter_deg < _VEHICLE_SCATTER_DEG
