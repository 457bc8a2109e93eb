"""One pass over the frames as they arrive: depth, ground plane, snippet poses, visual odometry, features."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, Self

import numpy as np

from slam.config.sections import SlamConfig
from slam.frames import DepthMap, Frame, Intrinsics, Predictor, SnippetPoses
from slam.frontend.drive import Drive, Keyframe
from slam.frontend.failure import MeasurementFailure
from slam.frontend.image_gate import ImageGate, Verdict
from slam.frontend.scale.road_homography import RoadHomography, RoadStep
from slam.frontend.scale.road_plane import GroundPlaneFitter
from slam.frontend.step_table import path_between, shortest_by_start
from slam.frontend.visual.motion import Motion
from slam.frontend.visual.odometry import VisualOdometry
from slam.geometry.se3 import FloatArray, chain, is_se3
from slam.loops.descriptors import FeatureExtractor
from slam.pipeline.keyframe_tracking import KeyframeTracking
from slam.pipeline.observations import Observations
from slam.pipeline.pending import (
    PendingFrame,
    PendingTask,
    RecentFrame,
    has_moved_on,
    height_of,
    last_step,
    predicted_depth,
)
from slam.runtime.errors import MissingFrameError, SequenceError
from slam.runtime.memory import return_freed_memory
from slam.runtime.storage.spill import SpillFile
from slam.runtime.timing import Stopwatch

logger = logging.getLogger(__name__)
_NO_POSE = "its pose is no finite rigid transform and leaves a gap"


class Observer:
    """Measures the frames of one sequence in time order; a context that ends its threads.

    The networks run in a second thread while corners of the frame before are tracked in the first; road homography,
    relative rotations and keyframes are computed in a third. A task that depends on another waits for it, and its
    result is collected with the next frame, so results do not depend on the timing of threads.

    With ``depth.frame_stride`` above 1, depth is carried to the frames between by the measured motion, and snippets
    touch. While keyframes alone measure the camera, depth is predicted for them alone.
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
            predictor: depth and snippet poses.
            intrinsics: of all images.
            config: of all parts.
            stopwatch: measures the time of stages.
            seed: of all RANSAC draws.
            camera_height_m: above the road; None where unknown.
        """
        self._predictor = predictor
        self._config = config
        self._baseline = config.visual_odometry.rotation_baseline_steps
        self._stopwatch = stopwatch
        self._drive = Drive()
        self._gate = ImageGate()
        self._odometry = VisualOdometry(config.visual_odometry, intrinsics, seed)
        parts = config.keyframes, config.loops, intrinsics, seed, camera_height_m
        self._keyframes = KeyframeTracking(*parts, self._predict_depth)
        self._road = RoadHomography(config.road, intrinsics)
        self._plane = GroundPlaneFitter(config.scale, intrinsics, seed)
        self._features = FeatureExtractor(intrinsics)
        self._snippet_frames: tuple[Frame, ...] = ()
        self._recent: tuple[RecentFrame, ...] = ()
        self._unread = 0  # frames in a row whose image cannot be read
        self._depth_index = -1  # the last frame whose depth was asked for
        self._spill_file = SpillFile()
        self._networks = predictor.executor()
        self._beside = ThreadPoolExecutor(max_workers=1, thread_name_prefix="beside")
        self._pending: PendingFrame | None = None
        self._depth: Future[DepthMap] | None = None  # of the frame that is processed
        self._tasks: list[PendingTask] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the threads; tasks that have not begun are dropped."""
        self._keyframes.close()
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
        with self._stopwatch.stage("read"):
            verdict: Verdict = self._gate.check(frame) if self._config.gaps.enabled else "new"
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

    def observations(self) -> Observations:
        """All measurements so far; more frames may follow."""
        self.flush()
        maps = self._keyframes.maps(self._drive)
        events = list(self._keyframes.events)
        return Observations(self._drive.copy(), self._gate.state, self._odometry.state, maps, events)

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
        sources, index, stride = self._predictor.sources, frame.index, self._config.depth.predicted_stride
        is_first = len(self._snippet_frames) == sources  # since a gap
        self._snippet_frames = (*self._snippet_frames, frame)[-sources - 1 :]
        # what was measured two frames ago is finished, whatever else is
        by_keyframes, step = self._keyframes.measures(self._drive, index - 2), last_step(self._drive, index - 2)
        is_dense = not by_keyframes and (step is None or stride == 1)
        far = step is not None and has_moved_on(self._drive, step, index + 1 - self._depth_index)
        after_frozen = self._drive.repeated[-1:] == [index - 1]  # what it hid is not carried
        is_seen = not by_keyframes and (step is None or far or index % stride == 0 or after_frozen)
        depth = snippet = None
        if is_seen:
            self._depth_index, depth = index, self._networks.submit(predicted_depth, self._predictor, frame)
        if len(self._snippet_frames) > sources and (is_first or is_dense or index % sources == 0):
            snippet = self._networks.submit(self._predictor.snippet, list(self._snippet_frames))
        return PendingFrame(frame, depth, snippet, self._gate.state.standing)

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
        frame, self._depth = pending.frame, pending.depth
        self._finish_tasks("depth network")  # of a keyframe, whose points depend on it
        with self._stopwatch.stage("keyframes"):
            self._keyframes.follow(frame)
        with self._stopwatch.stage("geometry"):
            measure = self._config.visual_odometry.enabled and not self._keyframes.measures(self._drive, frame.index)
            step = self._measure_step(self._recent[-1], pending) if measure and self._recent else None
            rotation = self._relative_rotation(frame)
        self._finish_tasks()
        self._keyframes.choose(self._drive)
        if pending.snippet is not None:
            self._tasks.append(PendingTask("pose network", pending.snippet, self._keep_snippet))
        if rotation is not None:
            self._tasks.append(PendingTask("geometry", self._beside.submit(rotation), self._keep_rotation))
        if self._config.road.enabled and step is not None:
            self._tasks.append(self._road_task(self._recent[-1].frame, pending, step))
        self._drive.roads.append(MeasurementFailure("its depth was not predicted"))
        self._recent = (*self._recent, RecentFrame(frame, None, None))[-self._baseline :]
        if pending.depth is not None:
            with self._stopwatch.stage("depth network"):
                depth = pending.depth.result()
            self._learn(pending, depth)
        elif self._depth is not None:  # of a keyframe
            self._tasks.append(PendingTask("depth network", self._depth, partial(self._learn, pending)))

    def _predict_depth(self, keyframe: Frame) -> None:
        """Predict the depth of a keyframe while it is adjusted, unless it was asked for before."""
        self._depth = self._depth or self._networks.submit(predicted_depth, self._predictor, keyframe)

    def _learn(self, pending: PendingFrame, depth: DepthMap) -> None:
        """Everything that the depth ``(H, W)`` of a frame gives."""
        frame, depth = pending.frame, pending.visible(depth)
        with self._stopwatch.stage("road"):
            self._drive.roads[frame.index] = road = self._plane.fit(depth, self._odometry.state.depth_error)
        self._keyframes.learn(frame, depth)
        height = self._remember(frame, depth, height_of(road))
        views, loops = self._drive.views, self._config.loops
        if loops.enabled and (not views or frame.index - views[-1].index >= loops.frame_stride):
            with self._stopwatch.stage("loops"):
                view = self._features.view(frame, depth, height)
                learned = view.points[:, 2].astype(np.float64)
                views.append(view.scaled(self._odometry.state.depth_error.corrected(learned) / learned))
        self._keep(frame, depth)

    def _known(self, recent: RecentFrame) -> tuple[DepthMap, float | None]:
        """Depth and camera height, predicted late where nobody asked for them before."""
        if recent.depth is not None:
            return recent.depth, recent.height
        carried = self._carried(recent)
        if carried is not None:
            return carried
        depth = self._networks.submit(predicted_depth, self._predictor, recent.frame).result()
        road = self._plane.fit(depth, self._odometry.state.depth_error)
        return depth, self._remember(recent.frame, depth, height_of(road))

    def _carried(self, recent: RecentFrame) -> tuple[DepthMap, float | None] | None:
        """Depth of the frame before a recent one, moved with the camera, and its height; None where one is unknown."""
        step = last_step(self._drive, recent.frame.index)
        before = next((r for r in self._recent if step is not None and r.frame.index == step.ends[0]), None)
        if step is None or before is None or before.depth is None:
            return None
        depth = self._odometry.carried(before.depth, step)
        if depth is None:
            return None
        self._keep(recent.frame, depth)
        return depth, self._remember(recent.frame, depth, before.height)

    def _remember(self, frame: Frame, depth: DepthMap, height: float | None) -> float | None:
        """Keep the depth of a recent frame and its camera height, which is returned."""
        self._recent = tuple(replace(r, depth=depth, height=height) if r.frame is frame else r for r in self._recent)
        return height

    def _measure_step(self, previous: RecentFrame, pending: PendingFrame) -> Motion | None:
        """The motion from the frame before; None where it could not be measured or triangulated no point."""
        depth, height = self._known(previous)
        current = pending.frame
        measured = self._odometry.measure(previous.frame, current, depth, height, pending.standing)
        if isinstance(measured, Motion) and not is_se3(measured.relative_pose.T_from_to):
            measured = MeasurementFailure(_NO_POSE)
        if isinstance(measured, MeasurementFailure):
            self._drive.failures.append((previous.frame.index, current.index, measured.reason))
            logger.info("geometry %d -> %d failed: %s", previous.frame.index, current.index, measured.reason)
            return None
        self._drive.motions.append(measured)
        return measured if measured.is_triangulated else None

    def _relative_rotation(self, current: Frame) -> Callable[[], Any] | None:
        """Prepare to measure the rotation across the last steps, if all of them were triangulated."""
        if self._baseline < 2 or len(self._recent) < self._baseline:
            return None
        first = self._recent[-self._baseline]
        motions = {m.ends: m for m in self._drive.motions[-2 * self._baseline :] if m.is_triangulated}
        path = path_between(shortest_by_start(motions), first.frame.index, current.index)
        if path is None or len(path) != self._baseline:
            return None
        T_first_current = chain(np.array([motions[ends].relative_pose.T_from_to for ends in path]))[-1]
        return self._odometry.relative_rotation(first.frame, current, self._known(first)[0], T_first_current)

    def _keep_snippet(self, snippet: SnippetPoses) -> None:
        if is_se3(snippet.T_source_target):
            self._drive.snippets.append(snippet)
        else:
            logger.warning("the pose network around frame %d: %s", snippet.target, _NO_POSE)

    def _keep_rotation(self, rotation: Any) -> None:
        if rotation is not None:
            self._drive.relative_rotations.append(rotation)

    def _road_task(self, previous: Frame, pending: PendingFrame, motion: Motion) -> PendingTask:
        def keep(step: RoadStep | MeasurementFailure) -> None:
            if isinstance(step, RoadStep):
                self._drive.road_steps[motion.ends] = step
            else:
                logger.info("road %d -> %d failed: %s", *motion.ends, step.reason)

        frames, T_previous_current = (previous, pending.frame), motion.relative_pose.T_from_to
        measured = self._beside.submit(self._road.measure, *frames, T_previous_current, pending.standing)
        return PendingTask("road", measured, keep)

    def _finish_tasks(self, stage: str | None = None) -> None:
        """Wait for the tasks of the last frame, or for those of one stage alone."""
        tasks = [task for task in self._tasks if stage in (None, task.stage)]
        self._tasks = [task for task in self._tasks if task not in tasks]  # so that a failed one is not raised again
        for task in tasks:
            with self._stopwatch.stage(task.stage):
                task.keep(task.result.result())

    def _keep(self, frame: Frame, depth: DepthMap) -> None:
        """Keep a thinned frame for the map."""
        mapping = self._config.mapping
        if mapping.enabled and frame.index % mapping.frame_stride == 0:
            keyframe = self._beside.submit(Keyframe.of, frame, depth, self._spill_file, mapping)
            self._tasks.append(PendingTask("map", keyframe, self._drive.keyframes.append))
