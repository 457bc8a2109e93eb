"""One pass over the frames as they arrive: depth, ground plane, snippet poses, visual odometry, features."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Self

import numpy as np

from erfsfm.common.errors import OneLineError, explained, shows_traceback
from slam.config.sections import SlamConfig
from slam.frames import (
    DepthMap,
    Ends,
    Frame,
    Intrinsics,
    Mask,
    Predictor,
    SnippetPoses,
    resized_mask,
)
from slam.frontend.drive import Drive, Keyframe
from slam.frontend.fixed_mask import FixedMask
from slam.frontend.ground_plane import GroundPlaneFitter
from slam.frontend.image_gate import ImageGate, Verdict
from slam.frontend.road import RoadHomography, RoadStep
from slam.frontend.tracking import LONGEST_STEP, ROTATION_BASELINE
from slam.frontend.visual.motion import Motion, path_between, shortest_by_start
from slam.frontend.visual.odometry import PNP_SOURCE, VisualOdometry
from slam.geometry.se3 import FloatArray, chain, invert, is_se3
from slam.loops.features import FeatureExtractor
from slam.pipeline.front_end_choice import KeyframeTracking
from slam.runtime.errors import Failed, MissingFrameError, SequenceError, SlamError
from slam.runtime.memory import SpillFile, return_freed_memory
from slam.runtime.stopwatch import Stopwatch

logger = logging.getLogger(__name__)

_NO_POSE = "its pose is no finite rigid transform and leaves a gap"
_MOVED_ON_HEIGHTS = 1.5  # way of the camera after which depth is predicted again, camera heights
# a frame that cannot be told apart from the one before is compared with an earlier one: least share of
# its corners that are found again, and by how many sigmas the camera has moved
_LEAST_SEEN, _MOVED_SIGMAS = 0.5, 3.0
_LAST_ROADS = 8  # looked back for the camera's height, frames
_MOST_UNREAD = 30  # unreadable images in a row: three seconds at 10 Hz, beyond which the motion cannot be guessed
# frames between views for loops: a car goes some 4 m, still the same place to a descriptor
_LOOP_STRIDE = 4


@dataclass
class FrameInWork:
    """A frame, what the networks were asked of it (None: nothing).

    Its ``depth`` ``(H, W)`` and the camera's ``height``, unscaled, are None until they are known.
    """

    frame: Frame
    prediction: Future[DepthMap] | None
    snippet: Future[SnippetPoses] | None
    depth: DepthMap | None = None
    height: float | None = None


# a frame from which later ones cannot be told apart, ``T_frame_last``, and the steps to them by it
Apart = tuple[FrameInWork, FloatArray, list[Motion]]


@dataclass(frozen=True)
class Task:
    """Work of another thread, the stage that waits for it, and what to do with its ``result`` where there is one."""

    stage: str
    result: Future[Any]
    keep: Callable[[Any], None]


class Observer:
    """Measures the frames of one sequence in time order; a context that ends its threads.

    The networks run in a second thread while corners of the frame before are tracked in the first; road homography,
    relative rotations and keyframes are computed in a third. A task that depends on another waits for it, and its
    result is collected with the next frame, so results do not depend on the timing of threads.

    With ``depth.frame_stride`` above 1, depth is carried to the frames between by the measured motion, and snippets
    touch. While ``keyframes`` alone measure the camera, depth is predicted for them alone.
    """

    def __init__(
        self,
        predictor: Predictor,
        intrinsics: Intrinsics,
        config: SlamConfig,
        stopwatch: Stopwatch,
        seed: int = 0,
        camera_height_m: float | None = None,
    ) -> None:
        """Prepare for the first frame.

        Args:
            predictor: of depth and snippet poses.
            intrinsics: of all images.
            config: all settings.
            stopwatch: that times the stages.
            seed: of all RANSAC draws.
            camera_height_m: above the road, metres; None where unknown.
        """
        self._predictor, self._config, self._stopwatch = predictor, config, stopwatch
        self.drive = Drive()  # the measurements so far
        self.gate = ImageGate()
        self.fixed = FixedMask()
        self._last_found: Mask | None = None  # and, joined with the mask that was given:
        self._last_joined: Mask | None = None
        self._odometry = VisualOdometry(intrinsics, seed)
        self.keyframes = KeyframeTracking(
            config.keyframes, config.loops, intrinsics, seed, camera_height_m, self._ask_depth
        )
        self._road = RoadHomography(intrinsics)
        self._plane = GroundPlaneFitter(intrinsics, seed)
        self._features = FeatureExtractor(intrinsics)
        self._snippet_frames: tuple[Frame, ...] = ()
        self._recent: tuple[FrameInWork, ...] = ()
        self._apart: Apart | None = None
        self._unread = 0  # frames in a row whose image cannot be read
        self._failed = 0  # and whose measurement failed
        self._depth_index = -1  # the last frame whose depth was asked for
        self._spill_file = SpillFile()
        self._networks = predictor.executor()
        self._beside = ThreadPoolExecutor(max_workers=1, thread_name_prefix="beside")
        self._pending: FrameInWork | None = None
        self._current: FrameInWork | None = None
        self._tasks: list[Task] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the threads; tasks that have not begun are dropped."""
        self.keyframes.close()
        for executor in (self._networks, self._beside):
            executor.shutdown(wait=True, cancel_futures=True)

    def add(self, index: int, frame: Frame | SequenceError) -> None:
        """Process the next frame, or the reason why its image cannot be read.

        Raises:
            SequenceError: the frame's own, where too many in a row could not be read.
        """
        if index % 200 == 0:  # 24 MB
            return_freed_memory()
        if isinstance(frame, SequenceError):
            # never ends a run
            is_missing = isinstance(frame, MissingFrameError) and self._config.gaps.enabled
            self._unread += not is_missing
            if not (is_missing or self._is_gap(self._unread)):
                raise frame
            self._leave_out(index, str(frame))
            return
        self._unread = 0
        frame = replace(frame, fixed=self._joined(frame.fixed))
        self.drive.fixed = frame.fixed
        with self._stopwatch.stage("read"):
            verdict: Verdict = self.gate.check(frame) if self._config.gaps.enabled else "new"
        if isinstance(verdict, Failed):
            self._leave_out(index, verdict.reason)
            return
        if verdict == "new":
            self.fixed.follow(frame.grey)
        asked = self._ask_networks(frame)
        try:
            self._measure_pending()
        finally:
            self._pending = asked
            if verdict == "repeated":  # what is measured of the frame before does not know it
                self.drive.repeated.append(index)
                if self.gate.was_moving:
                    self.drive.moving.append(index)

    def flush(self) -> None:
        """Finish every frame so far."""
        self._measure_pending()
        while self._tasks:
            self._measure(len(self.drive) - 1, self._finish_tasks)

    def measured(self) -> Drive:
        """All measurements so far, which stay while more frames follow."""
        self.flush()
        drive = self.drive.copy()
        drive.depth_error, drive.focal_length = (
            self._odometry.depth_error,
            self._odometry.focal_length,
        )
        drive.maps = self.keyframes.maps(drive)
        drive.events = list(self.keyframes.events)
        return drive

    @property
    def frames(self) -> int:
        """Number of frames so far."""
        return len(self.drive) + (self._pending is not None)

    def _joined(self, given: Mask | None) -> Mask | None:
        """What is found to be fixed to the camera, and the ``given`` ``(H, W)``; one object while it is the same."""
        found = self.fixed.mask
        if given is None or found is None:
            return found if given is None else given
        if found is not self._last_found:
            self._last_found = found
            self._last_joined = given | resized_mask(found, *given.shape[::-1])
        return self._last_joined

    def _is_gap(self, frames: int) -> bool:
        """Whether so many frames in a row may be without a measurement."""
        return self._config.gaps.enabled and frames <= _MOST_UNREAD

    def _leave_out(self, index: int, reason: str) -> None:
        try:
            self._measure_pending()
        finally:  # the error is of the frame before
            self.drive.unusable[index] = reason
            self.drive.roads.append(Failed(reason))
            self._snippet_frames = ()

    def _ask_networks(self, frame: Frame) -> FrameInWork:
        """Submit what is wanted of a frame: the one place that decides what the networks predict."""
        sources, index, drive = self._predictor.sources, frame.index, self.drive
        stride = self._config.depth.predicted_stride
        is_first = len(self._snippet_frames) == sources  # since a gap
        self._snippet_frames = (*self._snippet_frames, frame)[-sources - 1 :]
        # what was measured two frames ago is finished, whatever else is
        by_keyframes, step = self.keyframes.measures(drive, index - 2), drive.last_step(index - 2)
        has_moved = False  # whether as many more steps as this one leave what the last predicted depth shows
        if step is not None:
            roads = drive.roads[: step.ends[1] + 1][-_LAST_ROADS:]
            height = next(
                (road for road in reversed(roads) if not isinstance(road, Failed)), math.inf
            )
            way = (index + 1 - self._depth_index) * step.length_unscaled
            has_moved = way > _MOVED_ON_HEIGHTS * height
        after_frozen = drive.repeated[-1:] == [index - 1]  # what it hid is not carried
        wants_depth = not by_keyframes and (
            step is None or has_moved or index % stride == 0 or after_frozen
        )
        is_dense = not by_keyframes and (step is None or stride == 1)
        wants_snippet = len(self._snippet_frames) > sources and (
            is_first or is_dense or index % sources == 0
        )
        asked = FrameInWork(frame, None, None)
        if wants_depth:
            self._depth_index, asked.prediction = index, self._predict(frame)
        if wants_snippet:
            asked.snippet = self._networks.submit(
                self._predictor.snippet, list(self._snippet_frames)
            )
        return asked

    def _predict(self, frame: Frame) -> Future[DepthMap]:
        """Depth ``(H, W)`` of a frame, by the networks' thread; ``SlamError`` where a user's predictor errs."""

        def predict() -> DepthMap:
            depth, wanted = self._predictor.depth(frame), frame.image.shape[:2]
            shape, kind = np.shape(depth), getattr(depth, "dtype", type(depth).__name__)
            if shape != wanted or kind != np.float32:
                raise SlamError(
                    f"the predictor's depth of frame {frame.index} must be {wanted} float32; got {shape} {kind}"
                )
            return depth

        return self._networks.submit(predict)

    def _ask_depth(self, keyframe: Frame) -> None:
        """Predict the depth of a keyframe while it is adjusted, unless it was asked for before."""
        if self._current is not None and self._current.prediction is None:
            self._current.prediction = self._predict(keyframe)

    def _measure_pending(self) -> None:
        """All measurements but the networks' of the pending frame."""
        pending, self._pending = self._pending, None
        if pending is None:
            return
        self._measure(pending.frame.index, partial(self._stages, pending))

    def _measure(self, index: int, compute: Callable[[], None]) -> None:
        """Compute what is measured of a frame, which is a gap after an error that nobody foresaw.

        Known errors are for the user to mend; too many in a row are not of single frames.
        """
        try:
            compute()
        except Exception as error:
            self._tasks.clear()
            self._recent, self._apart = (), None
            reason = f"it could not be measured: {explained(error)}"
            self.drive.unusable[index] = reason
            if len(self.drive) == index:  # one entry in ``roads`` as all frames
                self.drive.roads.append(Failed(reason))
            self._failed += 1
            is_known = isinstance(error, OneLineError | OSError | MemoryError)
            if is_known or shows_traceback() or not self._is_gap(self._failed):
                raise
            logger.warning("frame %d is a gap: %s", index, reason)
        else:
            self._failed = 0

    def _stages(self, current: FrameInWork) -> None:
        """The stages of a frame; the tasks that they leave to other threads end with the next frame."""
        self._current, was_asked = current, current.prediction is not None
        previous, drive = self._recent[-1] if self._recent else None, self.drive
        self._finish_tasks("depth network")  # of a keyframe, whose points depend on it
        with self._stopwatch.stage("keyframes"):
            self.keyframes.follow(current.frame)
        with self._stopwatch.stage("geometry"):
            step = self._step(previous, current)
            rotation = self._relative_rotation(current.frame)
        self._finish_tasks()
        self.keyframes.choose(drive)
        drive.roads.append(Failed("its depth was not predicted"))
        self._recent = (*self._recent, current)[-ROTATION_BASELINE:]
        if current.snippet is not None:
            self._tasks.append(Task("pose network", current.snippet, self._keep_snippet))
        if rotation is not None:
            keep_rotation = self.drive.relative_rotations.append
            self._tasks.append(Task("geometry", self._beside.submit(rotation), keep_rotation))
        if step is not None:
            first, motion = step
            arguments = first, current.frame, motion.relative_pose.T_from_to
            measured = self._beside.submit(self._road.measure, *arguments)
            self._tasks.append(Task("road", measured, partial(self._keep_road, motion.ends)))
        if current.prediction is not None:
            self._tasks.append(
                Task("depth network", current.prediction, partial(self._learn, current))
            )
        if was_asked:  # that of a keyframe comes while it is adjusted
            self._finish_tasks("depth network")

    def _learn(self, current: FrameInWork, depth: DepthMap) -> None:
        """Everything that the depth ``(H, W)`` of a frame gives."""
        frame, error = current.frame, self._odometry.depth_error
        if frame.fixed is not None:
            depth = np.where(resized_mask(frame.fixed, *depth.shape[::-1]), np.float32(0), depth)
        with self._stopwatch.stage("road"):
            self.drive.roads[frame.index] = road = self._plane.fit(depth, error)
        self.keyframes.learn(frame, depth)
        current.depth, current.height = depth, None if isinstance(road, Failed) else road
        views, loops = self.drive.views, self._config.loops
        if loops.enabled and (not views or frame.index - views[-1].index >= _LOOP_STRIDE):
            with self._stopwatch.stage("loops"):
                view = self._features.view(frame, depth, current.height)
                learned = view.points[:, 2].astype(np.float64)
                views.append(view.scaled(error.corrected(learned) / learned))
        self._keep_for_map(frame, depth)

    def _depth_of(self, recent: FrameInWork) -> DepthMap:
        """Depth ``(H, W)`` of a recent frame: where it was not predicted that of the frame before, moved, else late."""
        if recent.depth is not None:
            return recent.depth
        step = self.drive.last_step(recent.frame.index)
        before = next(
            (r for r in self._recent if step is not None and r.frame.index == step.ends[0]), None
        )
        if step is not None and before is not None and before.depth is not None:
            recent.depth, recent.height = self._odometry.carried(before.depth, step), before.height
        if recent.depth is not None:
            self._keep_for_map(recent.frame, recent.depth)
            return recent.depth
        recent.depth = self._predict(recent.frame).result()
        road = self._plane.fit(recent.depth, self._odometry.depth_error)
        recent.height = None if isinstance(road, Failed) else road
        return recent.depth

    def _step(
        self, previous: FrameInWork | None, current: FrameInWork
    ) -> tuple[Frame, Motion] | None:
        """The motion from an earlier frame, usually the one before, that triangulated points; None without one."""
        wanted = self._config.visual_odometry.enabled and not self.keyframes.measures(
            self.drive, current.frame.index
        )
        apart, self._apart = self._apart, None
        if previous is None or not wanted:
            return None
        first, measured = previous, self._motion(previous, current)
        if isinstance(measured, Motion) and not measured.is_triangulated:
            first, measured = self._told_apart(
                apart or (previous, np.eye(4), []), previous.frame.index, current, measured
            )
        if isinstance(measured, Motion) and not is_se3(measured.relative_pose.T_from_to):
            measured = Failed(_NO_POSE)
        if isinstance(measured, Failed):
            ends = previous.frame.index, current.frame.index
            self.drive.failures.append((*ends, self._odometry.found))
            logger.info("geometry %d -> %d failed: %s", *ends, measured.reason)
            return None
        self.drive.motions.append(measured)
        return (first.frame, measured) if measured.is_triangulated else None

    def _told_apart(
        self, apart: Apart, previous: int, current: FrameInWork, step: Motion
    ) -> tuple[FrameInWork, Motion]:
        """The frame with which one is compared, and the motion to it.

        From the frame ``previous`` there is a ``step`` without parallax. Where the camera has moved
        since the last frame from which it can be told apart, what is known by that one replaces the
        steps between.
        """
        first, T_first_previous, between = apart
        wide = self._motion(first, current) if previous > first.frame.index else step
        motions, frames = self.drive.motions, current.frame.index - first.frame.index
        if not isinstance(wide, Motion) or wide.support < _LEAST_SEEN or frames > LONGEST_STEP:
            return first, step
        if not wide.is_triangulated:
            pose = wide.relative_pose
            T_previous_current = invert(T_first_previous) @ pose.T_from_to
            by_first = replace(
                pose, from_index=previous, T_from_to=T_previous_current, source=PNP_SOURCE
            )
            known = replace(wide, relative_pose=by_first)
            if wide.length_unscaled < _MOVED_SIGMAS * np.linalg.norm(pose.sigmas[3:]):
                self._apart = first, pose.T_from_to, [*between, known]
                return first, step
            self._apart, wide = (first, pose.T_from_to, []), known
        motions[len(motions) - len(between) :] = between
        return first, wide

    def _motion(self, first: FrameInWork, last: FrameInWork) -> Motion | Failed:
        depth = self._depth_of(first)
        return self._odometry.measure(first.frame, last.frame, depth, first.height)

    def _relative_rotation(self, current: Frame) -> Callable[[], Any] | None:
        """Prepare to measure the rotation across the last steps, if all of them were triangulated."""
        if len(self._recent) < ROTATION_BASELINE:
            return None
        first = self._recent[-ROTATION_BASELINE]
        motions = {
            m.ends: m for m in self.drive.motions[-2 * ROTATION_BASELINE :] if m.is_triangulated
        }
        path = path_between(shortest_by_start(motions), first.frame.index, current.index)
        if path is None or len(path) != ROTATION_BASELINE:
            return None
        T_first_current = chain(np.array([motions[ends].relative_pose.T_from_to for ends in path]))[
            -1
        ]
        return self._odometry.relative_rotation(
            first.frame, current, self._depth_of(first), T_first_current
        )

    def _keep_road(self, ends: Ends, step: RoadStep | Failed) -> None:
        if isinstance(step, RoadStep):
            self.drive.road_steps[ends] = step
        else:
            logger.info("road %d -> %d failed: %s", *ends, step.reason)

    def _keep_snippet(self, snippet: SnippetPoses) -> None:
        if is_se3(snippet.T_source_target):
            self.drive.snippets.append(snippet)
        else:
            logger.warning("the pose network around frame %d: %s", snippet.target, _NO_POSE)

    def _keep_for_map(self, frame: Frame, depth: DepthMap) -> None:
        """Keep a thinned frame for the map."""
        if self._config.mapping.enabled:
            keyframe = self._beside.submit(Keyframe.of, frame, depth, self._spill_file)
            self._tasks.append(Task("map", keyframe, self.drive.keyframes.append))

    def _finish_tasks(self, stage: str | None = None) -> None:
        """Wait for the tasks of the last frame, or for those of one stage alone."""
        tasks = [task for task in self._tasks if stage in (None, task.stage)]
        # so that a failed one is not raised again
        self._tasks = [task for task in self._tasks if task not in tasks]
        for task in tasks:
            with self._stopwatch.stage(task.stage):
                result = task.result.result()
            if result is not None:
                task.keep(result)
