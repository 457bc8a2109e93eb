"""One pass over the frames as they arrive: depth, road, snippet poses, image geometry, features."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from erfsfm.inference import limit_torch_threads
from slam.config import SlamConfig
from slam.errors import SequenceError
from slam.frames import DepthMap, Frame, Image, Intrinsics, Predictor, RelativePose, SnippetPoses
from slam.frames import Sequence as FrameSequence
from slam.frontend.failure import MeasurementFailure
from slam.frontend.gap_interpolation import interpolate_gaps
from slam.frontend.image_gate import ImageGate
from slam.frontend.scale.road_homography import RoadHomography, RoadStep
from slam.frontend.scale.road_plane import GroundPlane, fit_ground_plane
from slam.frontend.visual.odometry import Motion, VisualOdometry
from slam.frontend.visual.relative_rotation import RelativeRotation
from slam.loops.descriptors import FeatureExtractor, View
from slam.runtime.timing import Stopwatch
from slam.se3 import chain
from slam.storage.cache import GetOrCompute, without_cache
from slam.storage.serialisation import Learner
from slam.storage.spill import SpilledArray, SpillFile

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Keyframe:
    """What fusion needs of a frame, on disk until then."""

    index: int
    spilled_image: SpilledArray
    spilled_depth: SpilledArray

    @property
    def image(self) -> Image:
        """Thinned, ``(h, w, 3)``."""
        return self.spilled_image.read()

    @property
    def depth_unscaled(self) -> DepthMap:
        """Thinned, ``(h, w)``."""
        return self.spilled_depth.read()


@dataclass
class Observations:
    """What one pass over the frames saw, in the networks' unit of length.

    ``motions`` and ``road_steps`` hold what geometry and the road measured of the step from a frame to the next,
    ``relative_rotations`` the turns across several steps.
    """

    snippets: list[SnippetPoses] = field(default_factory=list)
    geometric: list[RelativePose] = field(default_factory=list)
    motions: dict[int, Motion] = field(default_factory=dict)
    road_steps: dict[int, RoadStep] = field(default_factory=dict)
    relative_rotations: list[RelativeRotation] = field(default_factory=list)
    failures: list[tuple[int, int, str]] = field(default_factory=list)
    roads: list[GroundPlane | MeasurementFailure] = field(default_factory=list)
    views: list[View] = field(default_factory=list)
    keyframes: list[Keyframe] = field(default_factory=list)
    examples: list[tuple[int, Image, DepthMap]] = field(default_factory=list)
    unusable: dict[int, str] = field(default_factory=dict)
    repeated: list[int] = field(default_factory=list)
    trusted: list[SnippetPoses] = field(default_factory=list)
    interpolated: list[RelativePose] = field(default_factory=list)
    bridged: dict[int, str] = field(default_factory=dict)


def read_frame(sequence: FrameSequence, index: int) -> Frame | SequenceError:
    """A frame, or why its image cannot be read."""
    try:
        frame = sequence.frame(index)
        frame.image.setflags(write=False)  # whoever remembers it need not copy it
        return frame
    except SequenceError as error:
        return error


@dataclass(frozen=True)
class PendingFrame:
    """A frame of which nothing but the networks was asked yet."""

    frame: Frame
    depth: Future[DepthMap]
    snippet: Future[SnippetPoses] | None


@dataclass(frozen=True)
class PendingTask:
    """What another thread was asked, the stage that waits for it, and what to do with the ``answer``."""

    stage: str
    answer: Future[Any]
    keep: Callable[[Any], None]


class Observer(Learner):
    """Watches the frames of one sequence in time order.

    The networks look at a frame in a second thread while corners of the one before are measured in the first; the road
    of a step, and the turn across it and those before, are measured in a third. What depends on another waits for it,
    and what nothing waits for is taken up with the next frame: results do not depend on which of them is faster.
    """

    remembers = ("_gate", "_geometry", "_aligner", "_window", "_recent", "_unread")

    def __init__(
        self,
        predictor: Predictor,
        intrinsics: Intrinsics,
        config: SlamConfig,
        watch: Stopwatch,
        examples: Collection[int] = (),
        get_or_compute: GetOrCompute = without_cache,
    ) -> None:
        """Prepare for the first frame.

        Args:
            predictor: depth and snippet poses.
            intrinsics: of all images.
            config: of all parts.
            watch: told where the time goes.
            examples: frames to keep whole for the report.
            recall: what images alone determine.
        """
        self.seen = Observations()
        self._predictor = predictor
        self._intrinsics = intrinsics
        self._config = config
        self._watch = watch
        self._examples = frozenset(examples)
        self._gate = ImageGate(config.gaps)
        self._geometry = VisualOdometry(config.geometry, intrinsics, get_or_compute)
        self._aligner = RoadHomography(config.road, intrinsics, get_or_compute)
        self._features = FeatureExtractor(config.loops, intrinsics, get_or_compute)
        self._steps = config.geometry.steps if config.geometry.enabled else ()
        self._window: deque[Frame] = deque(maxlen=predictor.sources + 1)
        self._recent: deque[tuple[Frame, DepthMap, float | None]] = deque(
            maxlen=max((*self._steps, config.geometry.rotation_baseline_steps))
        )
        self._unread = 0
        self._spill_file = SpillFile()
        self._networks = ThreadPoolExecutor(
            max_workers=1, thread_name_prefix="networks", initializer=limit_torch_threads
        )
        self._beside = ThreadPoolExecutor(max_workers=1, thread_name_prefix="beside")
        self._arrived: PendingFrame | None = None
        self._asked: list[PendingTask] = []

    def add(self, index: int, frame: Frame | SequenceError) -> None:
        """Watch the next frame, or learn that there is no image of it.

        Raises:
            SequenceError: the frame's own, where too many in a row could not be read.
        """
        if isinstance(frame, SequenceError):
            self._unread += 1
            if not self._config.gaps.enabled or self._unread > self._config.gaps.max_unread_frames:
                raise frame
            self._leave_out(index, str(frame))
            return
        self._unread = 0
        if self._config.gaps.enabled:
            with self._watch.stage("read"):
                verdict = self._gate.check(frame.image)
            if isinstance(verdict, MeasurementFailure):
                self._leave_out(index, verdict.reason)
                return
            if verdict == "repeated":
                self.seen.repeated.append(index)
        arrived = self._ask_networks(frame)
        self._watch_arrived()
        self._arrived = arrived

    def flush(self) -> None:
        """Finish with every frame so far; ``seen`` is complete then."""
        self._watch_arrived()
        self._finish_asked()

    def closed(self) -> Observations:
        """Everything seen so far with its gaps bridged; more frames may follow.

        Raises:
            SlamError: no snippet of usable frames.
        """
        self.flush()
        seen = self.seen
        closed = interpolate_gaps(
            len(seen.roads),
            self._predictor.sources,
            seen.snippets,
            seen.geometric,
            seen.unusable,
            seen.repeated,
            self._config.gaps,
        )
        return replace(
            seen,
            snippets=closed.snippets,
            trusted=closed.trusted,
            geometric=closed.geometric,
            interpolated=closed.interpolated,
            bridged=closed.frames,
            views=[view for view in seen.views if view.index not in closed.frames],
            keyframes=[keyframe for keyframe in seen.keyframes if keyframe.index not in closed.frames],
        )

    def _leave_out(self, index: int, reason: str) -> None:
        self._watch_arrived()
        self.seen.unusable[index] = reason
        self.seen.roads.append(MeasurementFailure(reason))
        self._window.clear()

    def _ask_networks(self, frame: Frame) -> PendingFrame:
        self._window.append(frame)
        depth = self._networks.submit(self._predictor.depth, frame)
        if len(self._window) < self._predictor.sources + 1:
            return PendingFrame(frame, depth, None)
        return PendingFrame(frame, depth, self._networks.submit(self._predictor.snippet, list(self._window)))

    def _watch_arrived(self) -> None:
        """All but the networks, of the frame that arrived last."""
        arrived, self._arrived = self._arrived, None
        if arrived is None:
            return
        seen, frame = self.seen, arrived.frame
        with self._watch.stage("geometry"):
            moved = self._measure_geometry(frame)
            span = self._relative_rotation(frame)
        self._finish_asked()
        if arrived.snippet is not None:
            self._asked.append(PendingTask("pose network", arrived.snippet, seen.snippets.append))
        self._asked.append(PendingTask("geometry", self._beside.submit(span), self._keep_relative_rotation))
        if moved is not None and self._config.road.enabled:
            self._asked.append(self._ask_road(moved, frame))
        with self._watch.stage("depth network"):
            depth = arrived.depth.result()
        with self._watch.stage("road"):
            road = fit_ground_plane(depth, self._intrinsics, self._config.scale)
        seen.roads.append(road)
        height = road.height_unscaled if isinstance(road, GroundPlane) else None
        self._recent.append((frame, depth, height))
        if self._config.loops.enabled and frame.index % self._config.loops.frame_stride == 0:
            with self._watch.stage("loops"):
                seen.views.append(self._features.view(frame, depth, height))
        self._keep(frame, depth)

    def _measure_geometry(self, current: Frame) -> tuple[Frame, Motion] | None:
        """Steps from earlier frames, by the depth of the earlier one; the frame before where its step has structure."""
        moved = None
        for step in self._steps:
            if len(self._recent) < step:
                continue
            previous, depth_previous, height = self._recent[-step]
            measured = self._geometry.measure(previous, current, depth_previous, height)
            if isinstance(measured, MeasurementFailure):
                self.seen.failures.append((previous.index, current.index, measured.reason))
                logger.info("geometry %d -> %d refused: %s", previous.index, current.index, measured.reason)
                continue
            self.seen.geometric.append(measured.relative_pose)
            if measured.triangulated is not None and current.index == previous.index + 1:
                self.seen.motions[previous.index] = measured
                moved = previous, measured
        return moved

    def _relative_rotation(self, current: Frame) -> Callable[[], RelativeRotation | None]:
        """How to measure the turn across the last steps, where each of them was measured."""
        wanted = self._config.geometry.rotation_baseline_steps
        steps = range(current.index - wanted, current.index)
        if wanted < 2 or len(self._recent) < wanted or not all(step in self.seen.motions for step in steps):
            return lambda: None
        first, depth_first, _ = self._recent[-wanted]
        T_first_current = chain(np.array([self.seen.motions[step].relative_pose.T_from_to for step in steps]))[-1]
        return self._geometry.relative_rotation_task(first, current, depth_first, T_first_current)

    def _keep_relative_rotation(self, span: RelativeRotation | None) -> None:
        if span is not None:
            self.seen.relative_rotations.append(span)

    def _ask_road(self, moved: tuple[Frame, Motion], current: Frame) -> PendingTask:
        previous, motion = moved
        T_previous_current = motion.relative_pose.T_from_to

        def keep(road_step: RoadStep | MeasurementFailure) -> None:
            if isinstance(road_step, MeasurementFailure):
                logger.info("road %d -> %d refused: %s", previous.index, current.index, road_step.reason)
            else:
                self.seen.road_steps[previous.index] = road_step

        return PendingTask(
            "road", self._beside.submit(self._aligner.measure, previous, current, T_previous_current), keep
        )

    def _finish_asked(self) -> None:
        """Wait for what was asked of the last frame."""
        for asked in self._asked:
            with self._watch.stage(asked.stage):
                asked.keep(asked.answer.result())
        self._asked.clear()

    def _keep(self, frame: Frame, depth: DepthMap) -> None:
        """Remember thinned frames for the map, and a few whole ones for the report."""
        mapping = self._config.mapping
        if frame.index in self._examples:
            self.seen.examples.append((frame.index, frame.image, depth))
        if not mapping.enabled or frame.index % mapping.frame_stride:
            return
        thinned = self._beside.submit(self._thinned, frame, depth)
        self._asked.append(PendingTask("map", thinned, self.seen.keyframes.append))

    def _thinned(self, frame: Frame, depth: DepthMap) -> Keyframe:
        height, width = depth.shape
        thinned = min(self._config.mapping.width_px / width, 1.0)
        size = (max(round(width * thinned), 1), max(round(height * thinned), 1))
        small = depth if thinned == 1.0 else cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
        image = frame.image if thinned == 1.0 else cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
        return Keyframe(frame.index, self._spill_file.put(image), self._spill_file.put(small))
