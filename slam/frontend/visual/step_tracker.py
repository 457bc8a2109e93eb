"""The step to each frame: from the one before, or from the last one from which it can be told apart."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from slam.frames import DepthMap, Ends, Frame, Intrinsics
from slam.frontend.measured import Measured
from slam.frontend.road import RoadHomography, RoadStep
from slam.frontend.tracking import LONGEST_STEP, ROTATION_BASELINE
from slam.frontend.visual.motion import Motion
from slam.frontend.visual.odometry import PNP_SOURCE, VisualOdometry
from slam.geometry.se3 import FloatArray, chain, invert, is_se3
from slam.runtime.errors import Failed

# a frame, its learned depth ``(H, W)``, and the camera's height above its ground plane, None where unknown
Seen = tuple[Frame, DepthMap, float | None]
# a frame from which later ones cannot be told apart, ``T_frame_last``, and the steps to them by it
Apart = tuple[Seen, FloatArray, list[Motion]]
# what another thread may compute: its stage, the work, and what keeps the result
Beside = tuple[str, Callable[[], Any], Callable[[Any], None]]

logger = logging.getLogger(__name__)

NO_POSE = "its pose is no finite rigid transform and leaves a gap"
# a frame that cannot be told apart from the one before is compared with an earlier one: least share of
# its corners that are found again, and by how many sigmas the camera has moved
_LEAST_SEEN, _MOVED_SIGMAS = 0.5, 3.0


class StepTracker:
    """Measures steps from frame to frame, the road's homography and rotations across several steps."""

    def __init__(
        self, intrinsics: Intrinsics, seed: int, measured: Measured, seen: Callable[[Frame], Seen]
    ) -> None:
        """Prepare for the first frame.

        Args:
            intrinsics: of all images.
            seed: of all RANSAC draws.
            measured: is given what is measured.
            seen: gives the depth of a recent frame; asked where it is needed alone.
        """
        self.odometry = VisualOdometry(intrinsics, seed)
        self._road = RoadHomography(intrinsics)
        self._measured, self._seen = measured, seen
        self._apart: Apart | None = None
        measured.below_is_nearer = self.odometry.below_is_nearer

    def add(self, recent: Sequence[Frame], current: Frame) -> list[Beside]:
        """Measure the step to a frame from the last ``recent`` one, and say what may be measured beside it.

        Without a recent frame, the next one is compared with none of those before.
        """
        apart, self._apart = self._apart, None
        if not recent:
            return []
        first = self._seen(recent[-1])
        step = self._motion(first, current)
        if isinstance(step, Motion) and not step.is_triangulated:
            first, step = self._told_apart(
                apart or (first, np.eye(4), []), recent[-1], current, step
            )
        if isinstance(step, Motion) and not is_se3(step.relative_pose.T_from_to):
            step = Failed(NO_POSE)
        if isinstance(step, Failed):
            ends = recent[-1].index, current.index
            self._measured.failures[ends] = self.odometry.found
            logger.info("geometry %d -> %d failed: %s", *ends, step.reason)
            return []
        self._measured.steps[step.ends] = step
        if not step.is_triangulated:
            return []
        road = partial(self._road.measure, first[0], current, step.relative_pose.T_from_to)
        keep_road = partial(self._keep_road, step.ends)
        return [*self._rotation(recent, current), ("road", road, keep_road)]

    def _motion(self, first: Seen, last: Frame) -> Motion | Failed:
        frame, depth, height = first
        return self.odometry.measure(frame, last, depth, height)

    def _told_apart(
        self, apart: Apart, previous: Frame, current: Frame, step: Motion
    ) -> tuple[Seen, Motion]:
        """The frame with which one is compared, and the motion to it.

        From the frame ``previous`` there is a ``step`` without parallax. Where the camera has moved
        since the last frame from which it can be told apart, what is known by that one replaces the
        steps between.
        """
        first, T_first_previous, between = apart
        wide = step if first[0] is previous else self._motion(first, current)
        frames = current.index - first[0].index
        if not isinstance(wide, Motion) or wide.support < _LEAST_SEEN or frames > LONGEST_STEP:
            return first, step
        if not wide.is_triangulated:
            pose = wide.relative_pose
            T_previous_current = invert(T_first_previous) @ pose.T_from_to
            by_first = replace(
                pose, from_index=previous.index, T_from_to=T_previous_current, source=PNP_SOURCE
            )
            known = replace(wide, relative_pose=by_first)
            if wide.length_unscaled < _MOVED_SIGMAS * np.linalg.norm(pose.sigmas[3:]):
                self._apart = first, pose.T_from_to, [*between, known]
                return first, step
            self._apart, wide = (first, pose.T_from_to, []), known
        self._measured.steps |= {each.ends: each for each in between}
        return first, wide

    def _rotation(self, recent: Sequence[Frame], current: Frame) -> list[Beside]:
        """The rotation across the last two steps, where both were triangulated."""
        if len(recent) < ROTATION_BASELINE:
            return []
        first, previous = recent[-ROTATION_BASELINE:]
        frames = first.index, previous.index, current.index
        steps = map(self._measured.steps.get, (frames[:2], frames[1:]))
        poses = [m.relative_pose.T_from_to for m in steps if m is not None and m.is_triangulated]
        if len(poses) < ROTATION_BASELINE:
            return []
        T_first_current = chain(np.array(poses))[-1]
        depth = self._seen(first)[1]
        rotation = self.odometry.relative_rotation(first, current, depth, T_first_current)
        keep = partial(self._measured.relative_rotations.__setitem__, frames)
        return [("geometry", rotation, keep)]

    def _keep_road(self, ends: Ends, step: RoadStep | Failed) -> None:
        if isinstance(step, RoadStep):
            self._measured.road_steps[ends] = step
        else:
            logger.info("road %d -> %d failed: %s", *ends, step.reason)
