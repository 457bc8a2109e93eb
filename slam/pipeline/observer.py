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
from slam.frames import DepthMap, Frame, Intrinsics, Predictor, SnippetPoses, resized_mask
from slam.frontend.fixed_mask import FixedMask
from slam.frontend.front_end import MotionTracker
from slam.frontend.ground_plane import GroundPlaneFitter
from slam.frontend.image_gate import ImageGate, Verdict
from slam.frontend.measured import Keyframe, Measured
from slam.frontend.tracking import ROTATION_BASELINE
from slam.frontend.visual.step_tracker import NO_POSE, Seen
from slam.geometry.se3 import is_se3
from slam.loops.features import FeatureExtractor
from slam.runtime.errors import Failed, MissingFrameError, SequenceError, SlamError
from slam.runtime.memory import SpillFile, return_freed_memory
from slam.runtime.stopwatch import Stopwatch

logger = logging.getLogger(__name__)

_MOVED_ON_HEIGHTS = 1.5  # way of the camera after which depth is predicted again, camera heights
_LAST_ROADS = 8  # looked back for the camera's height, frames
_MOST_UNREAD = 30  # unreadable images in a row: three seconds at 10 Hz, beyond which the motion cannot be guessed
# frames between views for loops: a car goes some 4 m, still the same place to a descriptor
_LOOP_STRIDE = 4


# the stage that waits for work of another thread, its result, and what keeps it where there is one
Task = tuple[str, Future[Any], Callable[[Any], None]]


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
        self.measured = Measured()  # so far
        self.gate = ImageGate()
        self.fixed = FixedMask()
        self.tracker = MotionTracker(
            config,
            intrinsics,
            self.measured,
            stopwatch,
            self._seen,
            self._ask_depth,
            seed,
            camera_height_m,
        )
        self._plane = GroundPlaneFitter(intrinsics, seed)
        self._features = FeatureExtractor(intrinsics)
        self._snippet_frames: tuple[Frame, ...] = ()
        self._recent: tuple[FrameInWork, ...] = ()
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
        self.tracker.close()
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
        given, found = frame.fixed, self.fixed.mask
        frame = replace(frame, fixed=given if found is None else found)
        self.measured.fixed = frame.fixed
        with self._stopwatch.stage("read"):
            verdict: Verdict = self.gate.check(frame) if self._config.gaps.enabled else "new"
        if isinstance(verdict, Failed):
            self._leave_out(index, verdict.reason)
            return
        if verdict == "new":
            self.fixed.follow(frame.grey, given)
        asked = self._ask_networks(frame)
        try:
            self._measure_pending()
        finally:
            self._pending = asked
            if verdict == "repeated":  # what is measured of the frame before does not know it
                self.measured.repeated.append(index)
                if self.gate.was_moving:
                    self.measured.moving.append(index)

    def flush(self) -> None:
        """Finish every frame so far."""
        self._measure_pending()
        while self._tasks:
            self._measure(len(self.measured) - 1, self._finish_tasks)

    def finish(self) -> Measured:
        """All measurements so far, which stay while more frames follow."""
        self.flush()
        return self.tracker.finish()

    @property
    def frames(self) -> int:
        """Number of frames so far."""
        return len(self.measured) + (self._pending is not None)

    def _is_gap(self, frames: int) -> bool:
        """Whether so many frames in a row may be without a measurement."""
        return self._config.gaps.enabled and frames <= _MOST_UNREAD

    def _leave_out(self, index: int, reason: str) -> None:
        try:
            self._measure_pending()
        finally:  # the error is of the frame before
            self.measured.unusable[index] = reason
            self.measured.roads.append(None)
            self._snippet_frames = ()

    def _ask_networks(self, frame: Frame) -> FrameInWork:
        """Submit what is wanted of a frame: the one place that decides what the networks predict."""
        sources, index, measured = self._predictor.sources, frame.index, self.measured
        stride = self._config.depth.predicted_stride
        is_first = len(self._snippet_frames) == sources  # since a gap
        self._snippet_frames = (*self._snippet_frames, frame)[-sources - 1 :]
        # what was measured two frames ago is finished, whatever else is
        by_keyframes = self.tracker.keyframes_alone(index - 2)
        step = measured.last_step(index - 2)
        has_moved = False  # whether as many more steps as this one leave what the last predicted depth shows
        if step is not None:
            roads = measured.roads[: step.ends[1] + 1][-_LAST_ROADS:]
            height = next((road for road in reversed(roads) if road is not None), math.inf)
            way = (index + 1 - self._depth_index) * step.length_unscaled
            has_moved = way > _MOVED_ON_HEIGHTS * height
        after_frozen = measured.repeated[-1:] == [index - 1]  # what it hid is not carried
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
            self._recent = ()
            reason = f"it could not be measured: {explained(error)}"
            self.measured.unusable[index] = reason
            if len(self.measured) == index:  # one entry in ``roads`` as all frames
                self.measured.roads.append(None)
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
        self._finish_tasks("depth network")  # of a keyframe, whose points depend on it
        beside = self.tracker.add([each.frame for each in self._recent], current.frame)
        self._finish_tasks()
        self.tracker.choose()
        self.measured.roads.append(None)
        self._recent = (*self._recent, current)[-ROTATION_BASELINE:]
        if current.snippet is not None:
            self._tasks.append(("pose network", current.snippet, self._keep_snippet))
        for stage, work, keep in beside:
            self._tasks.append((stage, self._beside.submit(work), keep))
        if current.prediction is not None:
            learn = partial(self._learn, current)
            self._tasks.append(("depth network", current.prediction, learn))
        if was_asked:  # that of a keyframe comes while it is adjusted
            self._finish_tasks("depth network")

    def _learn(self, current: FrameInWork, depth: DepthMap) -> None:
        """Everything that the depth ``(H, W)`` of a frame gives."""
        frame, error = current.frame, self.tracker.step_odometry.depth_error
        if frame.fixed is not None:
            depth = np.where(resized_mask(frame.fixed, *depth.shape[::-1]), np.float32(0), depth)
        with self._stopwatch.stage("road"):
            self.measured.roads[frame.index] = current.height = self._plane.fit(depth, error)
        self.tracker.learn(frame, depth)
        current.depth = depth
        views, loops = self.measured.views, self._config.loops
        if loops.enabled and (not views or frame.index - views[-1].index >= _LOOP_STRIDE):
            with self._stopwatch.stage("loops"):
                view = self._features.view(frame, depth, current.height)
                learned = view.points[:, 2].astype(np.float64)
                views.append(view.scaled(error.corrected(learned) / learned))
        self._keep_for_map(frame, depth)

    def _seen(self, frame: Frame) -> Seen:
        """A recent frame with its depth: where it was not predicted that of the frame before, moved, else late."""
        recent = next(each for each in self._recent if each.frame is frame)
        if recent.depth is None:
            recent.depth = self._carried(recent)
        if recent.depth is None:
            recent.depth = self._predict(frame).result()
            error = self.tracker.step_odometry.depth_error
            recent.height = self._plane.fit(recent.depth, error)
        return frame, recent.depth, recent.height

    def _carried(self, recent: FrameInWork) -> DepthMap | None:
        """The depth of the frame before, moved by the step to this one; None where it is not known."""
        step = self.measured.last_step(recent.frame.index)
        if step is None:
            return None
        before = next((each for each in self._recent if each.frame.index == step.ends[0]), None)
        if before is None or before.depth is None:
            return None
        depth, recent.height = self.tracker.step_odometry.carried(before.depth, step), before.height
        if depth is not None:
            self._keep_for_map(recent.frame, depth)
        return depth

    def _keep_snippet(self, snippet: SnippetPoses) -> None:
        if is_se3(snippet.T_source_target):
            self.measured.snippets[snippet.sources] = snippet
        else:
            logger.warning("the pose network around frame %d: %s", snippet.target, NO_POSE)

    def _keep_for_map(self, frame: Frame, depth: DepthMap) -> None:
        """Keep a thinned frame for the map."""
        if self._config.mapping.enabled:
            keyframe = self._beside.submit(Keyframe.of, frame, depth, self._spill_file)
            self._tasks.append(("map", keyframe, self.measured.keyframes.append))

    def _finish_tasks(self, stage: str | None = None) -> None:
        """Wait for the tasks of the last frame, or for those of one stage alone."""
        tasks, self._tasks = self._tasks, []  # so that a failed one is not raised again
        for task in tasks:
            of_stage, result, keep = task
            if stage not in (None, of_stage):
                self._tasks.append(task)
                continue
            with self._stopwatch.stage(of_stage):
                found = result.result()
            if found is not None:
                keep(found)
