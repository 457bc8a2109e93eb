"""One pass over the frames as they arrive: depth, ground plane, snippet poses, visual odometry, features."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Self

import numpy as np

from slam.config.sections import SlamConfig
from slam.frames import DepthMap, Frame, Intrinsics, Predictor, SnippetPoses
from slam.frontend.drive import Drive, Examples, Keyframe
from slam.frontend.failure import MeasurementFailure
from slam.frontend.gap_interpolation import complete_drive
from slam.frontend.image_gate import ImageGate, Verdict
from slam.frontend.keyframes.odometry import KeyframeOdometryState
from slam.frontend.scale.road_homography import RoadHomography, RoadStep
from slam.frontend.scale.road_plane import GroundPlane, GroundPlaneFitter
from slam.frontend.step_table import path_between, shortest_by_start
from slam.frontend.visual.motion import Motion
from slam.frontend.visual.odometry import VisualOdometry
from slam.geometry.se3 import FloatArray, chain
from slam.loops.descriptors import FeatureExtractor
from slam.pipeline.front_end_state import FrontEndState, RecentFrame
from slam.pipeline.keyframe_tracking import KeyframeTracking
from slam.runtime.errors import MissingFrameError, SequenceError, SlamError
from slam.runtime.memory import return_freed_memory
from slam.runtime.storage.spill import SpillFile
from slam.runtime.timing import Stopwatch

logger = logging.getLogger(__name__)
_MOVED_ON_HEIGHTS = 1.5  # way of the camera after which depth is predicted again, camera heights
_LAST_ROADS = 8  # looked back for the camera's height, frames


@dataclass(frozen=True)
class PendingFrame:
    """A frame submitted to the networks, whose other measurements are pending; None is not asked for."""

    frame: Frame
    depth: Future[DepthMap] | None
    snippet: Future[SnippetPoses] | None


@dataclass(frozen=True)
class PendingTask:
    """A task of another thread, the stage that waits for it, and what to do with its ``result``."""

    stage: str
    result: Future[Any]
    keep: Callable[[Any], None]


class Observer:
    """Measures the frames of one sequence in time order; a context that ends its threads.

    The networks run in a second thread while corners of the frame before are tracked in the first; road homography,
    relative rotations and keyframes are computed in a third. A task that depends on another waits for it, and its
    result is collected with the next frame, so results do not depend on the timing of threads.

    Depth is predicted where the camera has moved on, at least at every second frame, and carried to the next one by the
    measured motion. Snippets touch. Both are predicted for every frame that image geometry does not measure. While
    keyframes alone measure the camera, depth is predicted for them and the targets of snippets.
    """

    def __init__(
        self,
        predictor: Predictor,
        intrinsics: Intrinsics,
        config: SlamConfig,
        stopwatch: Stopwatch,
        examples: Examples | None = None,
        seed: int = 0,
        state: FrontEndState | None = None,
        camera_height_m: float | None = None,
    ) -> None:
        """Prepare for the first frame, or resume from a state.

        Args:
            predictor: depth and snippet poses.
            intrinsics: of all images.
            config: of all parts.
            stopwatch: measures the time of stages.
            examples: frames to keep whole for the report; None keeps none.
            seed: of all RANSAC draws.
            state: of an observer of the same predictor, camera and configuration.
            camera_height_m: above the road; None where unknown.
        """
        self._predictor = predictor
        self._config = config
        self._stopwatch = stopwatch
        self._examples = examples or Examples(range(0))
        self._drive = Drive() if state is None else state.drive.copy()
        self._gate = ImageGate(None if state is None else state.gate)
        self._odometry = VisualOdometry(
            config.visual_odometry, intrinsics, seed, None if state is None else state.odometry
        )
        keyframes = KeyframeOdometryState() if state is None else state.keyframes
        self._keyframes = KeyframeTracking(config.keyframes, config.loops, intrinsics, seed, keyframes, camera_height_m)
        self._keyframes.choose(self._drive)
        self._road = RoadHomography(config.road, intrinsics, () if state is None else state.road_directions)
        self._plane = GroundPlaneFitter(config.scale, intrinsics, seed)
        self._features = FeatureExtractor(intrinsics)
        self._snippet_frames: tuple[Frame, ...] = () if state is None else state.snippet_frames
        self._recent: tuple[RecentFrame, ...] = () if state is None else state.recent
        self._unread = 0 if state is None else state.unread
        self._depth_index = -1 if state is None else state.depth_index
        self._spill_file = SpillFile()
        self._networks = predictor.executor()
        self._beside = ThreadPoolExecutor(max_workers=1, thread_name_prefix="beside")
        self._pending: PendingFrame | None = None
        self._tasks: list[PendingTask] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the threads; tasks that have not begun are dropped."""
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
            self._require_readable(frame)
            self._leave_out(index, str(frame))
            return
        self._unread = 0
        verdict: Verdict = "new"
        if self._config.gaps.enabled:
            with self._stopwatch.stage("read"):
                verdict = self._gate.check(frame)
            if isinstance(verdict, MeasurementFailure):
                self._leave_out(index, verdict.reason)
                return
        pending = self._submit_networks(frame)
        try:
            self._process_pending()
        finally:
            self._pending = pending
            if verdict == "repeated":  # what is measured of the frame before does not know it
                self._drive.repeat(index, self._gate.was_moving)

    def flush(self) -> None:
        """Finish every frame so far."""
        self._process_pending()
        while self._tasks:
            self._finish_tasks()

    def state(self) -> FrontEndState:
        """A snapshot from which another observer continues as without an interruption."""
        self.flush()
        parts = self._gate.state(), self._odometry.state(), self._keyframes.state(), self._road.state()
        return FrontEndState(self._drive.copy(), *parts, self._snippet_frames, self._recent, self._unread, self._depth_index)

    @property
    def frames(self) -> int:
        """Number of frames so far."""
        return len(self._drive) + (self._pending is not None)

    @property
    def drive(self) -> Drive:
        """The measurements so far, which grow with the frames."""
        return self._drive

    def keyframe_step(self, index: int) -> tuple[int, FloatArray] | None:
        """As `KeyframeTracking.step`, of a finished frame."""
        return self._keyframes.step(index)

    def complete_drive(self) -> Drive:
        """Everything measured so far with its gaps interpolated; more frames may follow.

        Raises:
            SlamError: no snippet of usable frames.
        """
        self.flush()
        maps = self._keyframes.maps(self._drive)
        poses = self._keyframes.poses(maps)
        return complete_drive(self._drive, self._predictor.sources, maps, poses, self._keyframes.events)

    def _require_readable(self, error: SequenceError) -> None:
        """Raise after too many unreadable images in a row; missing ones are always accepted."""
        if isinstance(error, MissingFrameError) and self._config.gaps.enabled:
            return
        self._unread += 1
        if not self._config.gaps.enabled or self._unread > self._config.gaps.max_unread_frames:
            raise error

    def _leave_out(self, index: int, reason: str) -> None:
        try:
            self._process_pending()
        finally:  # the error is of the frame before
            self._drive.unusable[index] = reason
            self._drive.roads.append(MeasurementFailure(reason))
            self._snippet_frames = ()

    def _submit_networks(self, frame: Frame) -> PendingFrame:
        sources, index = self._predictor.sources, frame.index
        is_first = len(self._snippet_frames) == sources  # since a gap
        self._snippet_frames = (*self._snippet_frames, frame)[-sources - 1 :]
        # what was measured two frames ago is finished, whatever else is
        by_keyframes, step = self._keyframes.measures(self._drive, index - 2), self._last_step(index - 2)
        is_measured = by_keyframes or step is not None
        depth = snippet = None
        if by_keyframes:
            is_seen = (index + sources // 2) % sources == 0
        else:
            is_seen = step is None or self._has_moved_on(index, step)
        if is_seen or index in self._examples:
            self._depth_index = index
            depth = self._networks.submit(predicted_depth, self._predictor, frame)
        if len(self._snippet_frames) > sources and (is_first or not is_measured or index % sources == 0):
            snippet = self._networks.submit(self._predictor.snippet, list(self._snippet_frames))
        return PendingFrame(frame, depth, snippet)

    def _last_step(self, index: int) -> Motion | None:
        """The step to a frame, where image geometry measured it as the last."""
        last = self._drive.motions[-1] if self._drive.motions else None
        return last if last is not None and last.ends[1] == index else None

    def _has_moved_on(self, index: int, step: Motion) -> bool:
        """Whether the camera moves on from what the last predicted depth shows before the frame after this one."""
        if index % self._config.depth.frame_stride == 0:
            return True
        heights = [road.height_unscaled for road in self._drive.roads[-_LAST_ROADS:] if isinstance(road, GroundPlane)]
        far = _MOVED_ON_HEIGHTS * heights[-1] if heights else np.inf
        return (index + 1 - self._depth_index) * step.length_unscaled > far

    def _process_pending(self) -> None:
        """All measurements but the networks' of the pending frame."""
        pending, self._pending = self._pending, None
        if pending is None:
            return
        try:
            self._process(pending)
        except Exception as error:
            # callers may continue after this: the frame becomes a gap, with one entry in ``roads`` as all frames
            self._tasks.clear()
            self._recent = ()
            self._drive.unusable[pending.frame.index] = f"it could not be measured ({error})"
            if len(self._drive) == pending.frame.index:
                self._drive.roads.append(MeasurementFailure(str(error)))
            raise

    def _process(self, pending: PendingFrame) -> None:
        frame = pending.frame
        with self._stopwatch.stage("keyframes"):
            self._keyframes.follow(frame)
        with self._stopwatch.stage("geometry"):
            measure = self._config.visual_odometry.enabled and not self._keyframes.measures(self._drive, frame.index)
            step = self._measure_step(self._recent[-1], frame) if measure and self._recent else None
            rotation = self._relative_rotation(frame)
        self._finish_tasks()
        self._keyframes.choose(self._drive)
        if pending.snippet is not None:
            self._tasks.append(PendingTask("pose network", pending.snippet, self._drive.snippets.append))
        if rotation is not None:
            self._tasks.append(PendingTask("geometry", self._beside.submit(rotation), self._keep_rotation))
        if self._config.road.enabled and step is not None:
            self._tasks.append(self._road_task(self._recent[-1].frame, frame, step))
        self._drive.roads.append(MeasurementFailure("its depth was not predicted"))
        self._recent = (*self._recent, RecentFrame(frame, None, None))[
            -self._config.visual_odometry.rotation_baseline_steps :
        ]
        if pending.depth is not None:
            with self._stopwatch.stage("depth network"):
                depth = pending.depth.result()
            self._learn(frame, depth)
            self._keyframes.look_for_lost(frame, depth)
        elif self._keyframes.is_keyframe(frame.index):
            late = self._networks.submit(predicted_depth, self._predictor, frame)
            self._tasks.append(PendingTask("depth network", late, partial(self._learn, frame)))

    def _learn(self, frame: Frame, depth: DepthMap) -> None:
        """Everything that the depth ``(H, W)`` of a frame gives."""
        with self._stopwatch.stage("road"):
            self._drive.roads[frame.index] = road = self._plane.fit(depth, self._odometry.state().depth_error)
        self._keyframes.learn(frame, depth)
        height = self._remember(frame, depth, road)
        views, loops = self._drive.views, self._config.loops
        if loops.enabled and (not views or frame.index - views[-1].index >= loops.frame_stride):
            with self._stopwatch.stage("loops"):
                views.append(self._features.view(frame, depth, height))
        self._keep(frame, depth)

    def _known(self, recent: RecentFrame) -> tuple[DepthMap, float | None]:
        """Depth and camera height, predicted late where nobody asked for them before."""
        if recent.depth is not None:
            return recent.depth, recent.height
        carried = self._carried(recent)
        if carried is not None:
            self._recent = tuple(carried if r.frame is recent.frame else r for r in self._recent)
            self._keep_for_map(carried.frame, carried.depth)
            return carried.depth, carried.height
        depth = self._networks.submit(predicted_depth, self._predictor, recent.frame).result()
        return depth, self._remember(recent.frame, depth, self._plane.fit(depth, self._odometry.state().depth_error))

    def _carried(self, recent: RecentFrame) -> RecentFrame | None:
        """A recent frame with the depth of the one before it, moved; None where that or the motion is unknown."""
        step = self._last_step(recent.frame.index)
        before = next((r for r in self._recent if step is not None and r.frame.index == step.ends[0]), None)
        if step is None or before is None or before.depth is None:
            return None
        depth = self._odometry.carried(before.depth, step)
        return None if depth is None else replace(recent, depth=depth, height=before.height)

    def _remember(self, frame: Frame, depth: DepthMap, road: GroundPlane | MeasurementFailure) -> float | None:
        """Keep the depth of a recent frame, and the camera height that is returned."""
        height = road.height_unscaled if isinstance(road, GroundPlane) else None
        self._recent = tuple(replace(r, depth=depth, height=height) if r.frame is frame else r for r in self._recent)
        return height

    def _measure_step(self, previous: RecentFrame, current: Frame) -> Motion | None:
        """The motion from the frame before; None where it could not be measured or triangulated no point."""
        depth, height = self._known(previous)
        measured = self._odometry.measure(previous.frame, current, depth, height)
        if isinstance(measured, MeasurementFailure):
            self._drive.failures.append((previous.frame.index, current.index, measured.reason))
            logger.info("geometry %d -> %d failed: %s", previous.frame.index, current.index, measured.reason)
            return None
        self._drive.motions.append(measured)
        return measured if measured.is_triangulated else None

    def _relative_rotation(self, current: Frame) -> Callable[[], Any] | None:
        """Prepare to measure the rotation across the last steps, if all of them were triangulated."""
        baseline = self._config.visual_odometry.rotation_baseline_steps
        if baseline < 2 or len(self._recent) < baseline:
            return None
        first = self._recent[-baseline]
        motions = {m.ends: m for m in self._drive.motions[-2 * baseline :] if m.is_triangulated}
        path = path_between(shortest_by_start(motions), first.frame.index, current.index)
        if path is None or len(path) != baseline:
            return None
        T_first_current = chain(np.array([motions[ends].relative_pose.T_from_to for ends in path]))[-1]
        return self._odometry.relative_rotation(first.frame, current, self._known(first)[0], T_first_current)

    def _keep_rotation(self, rotation: Any) -> None:
        if rotation is not None:
            self._drive.relative_rotations.append(rotation)

    def _road_task(self, previous: Frame, current: Frame, motion: Motion) -> PendingTask:
        def keep(step: RoadStep | MeasurementFailure) -> None:
            if isinstance(step, RoadStep):
                self._drive.road_steps[motion.ends] = step
            else:
                logger.info("road %d -> %d failed: %s", *motion.ends, step.reason)

        T_previous_current = motion.relative_pose.T_from_to
        return PendingTask("road", self._beside.submit(self._road.measure, previous, current, T_previous_current), keep)

    def _finish_tasks(self) -> None:
        """Wait for the tasks of the last frame."""
        tasks, self._tasks = self._tasks, []  # so that a failed one is not raised again
        for task in tasks:
            with self._stopwatch.stage(task.stage):
                task.keep(task.result.result())

    def _keep(self, frame: Frame, depth: DepthMap) -> None:
        """Keep a thinned frame for the map, and a few whole ones for the report."""
        if frame.index in self._examples:
            self._examples.keep(frame, depth, self._drive.examples)
        self._keep_for_map(frame, depth)

    def _keep_for_map(self, frame: Frame, depth: DepthMap) -> None:
        mapping = self._config.mapping
        if mapping.enabled and frame.index % mapping.frame_stride == 0:
            keyframe = self._beside.submit(Keyframe.of, frame, depth, self._spill_file, mapping)
            self._tasks.append(PendingTask("map", keyframe, self._drive.keyframes.append))


def predicted_depth(predictor: Predictor, frame: Frame) -> DepthMap:
    """Depth ``(H, W)`` of a frame.

    Raises:
        SlamError: a user's predictor gives something else.
    """
    depth = predictor.depth(frame)
    wanted, shape, kind = frame.image.shape[:2], np.shape(depth), getattr(depth, "dtype", type(depth).__name__)
    if shape != wanted or kind != np.float32:
        raise SlamError(f"the predictor's depth of frame {frame.index} must be {wanted} float32; got {shape} {kind}")
    return depth
