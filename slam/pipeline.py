"""The system: `SlamPipeline.run` is its table of contents."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from slam.config import ScaleMode, SlamConfig
from slam.errors import SlamError
from slam.frames import DepthMap, Frame, Image, Predictor, RelativePose, SnippetPoses
from slam.frames import Sequence as FrameSequence
from slam.frontend.geometric_factors import GeometricOdometry
from slam.frontend.lidar_odometry import LidarPath, lidar_path
from slam.frontend.network_factors import NETWORK_SOURCE, chain_raw, measured_noise, network_factors
from slam.frontend.refusal import Refusal
from slam.frontend.scale import (
    RoadPlane,
    ScaleEstimate,
    fit_road,
    rescaled,
    resolve_mode,
    scale_from_reference,
    scale_from_road,
    scale_track,
)
from slam.loops.closure import LoopClosures, close_loops
from slam.loops.descriptors import FeatureExtractor, View
from slam.mapping import TsdfMap
from slam.pose_graph import PoseGraph
from slam.se3 import FloatArray, chain, invert
from slam.timing import Stopwatch
from slam.trajectory import Trajectory

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]
EXAMPLES = 5


@dataclass(frozen=True)
class Keyframe:
    """What fusion needs of a frame: a thinned image ``(h, w, 3)`` and unscaled depth ``(h, w)``."""

    index: int
    image: Image
    depth_unscaled: DepthMap


@dataclass
class Observations:
    """What one pass over the frames saw, in the networks' unit of length."""

    snippets: list[SnippetPoses] = field(default_factory=list)
    geometric: list[RelativePose] = field(default_factory=list)
    refusals: list[tuple[int, int, str]] = field(default_factory=list)
    roads: list[RoadPlane | Refusal] = field(default_factory=list)
    views: list[View] = field(default_factory=list)
    keyframes: list[Keyframe] = field(default_factory=list)
    examples: list[tuple[int, Image, DepthMap]] = field(default_factory=list)


@dataclass(frozen=True)
class Scale:
    """``per_frame`` ``(N,)`` times an unscaled length near that frame is a length in the mode's unit."""

    mode: ScaleMode
    estimate: ScaleEstimate | Refusal
    per_frame: FloatArray


@dataclass(frozen=True)
class SlamResult:
    """Trajectories with one row a frame, the graph, the map and how they came about."""

    network: Trajectory
    odometry: Trajectory
    optimised: Trajectory
    lidar: LidarPath | None
    reference: Trajectory | None
    observations: Observations
    scale: Scale
    factors: list[RelativePose]
    loops: LoopClosures
    graph: PoseGraph
    map: TsdfMap | None
    stopwatch: Stopwatch


class SlamPipeline:
    """From the frames of a sequence to a trajectory and a map."""

    def __init__(
        self, sequence: FrameSequence, predictor: Predictor, config: SlamConfig, progress: Progress | None = None
    ) -> None:
        self._sequence = sequence
        self._predictor = predictor
        self._config = config
        self._progress = progress or (lambda stage, done, total: None)
        self._watch = Stopwatch()

    def run(self) -> SlamResult:
        """Run the whole system.

        Raises:
            SlamError: the sequence is too short, unreadable, lacks what the scale mode wants, or leaves the graph
                without a solution.
        """
        estimate = self.estimate()
        return replace(estimate, map=self.fuse(estimate))

    def estimate(self) -> SlamResult:
        """Everything but the map, so that trajectories can be kept before fusion begins; raises as ``run``."""
        mode = self._require_possible()
        observations = self._observe()
        T_network = chain_raw(observations.snippets, len(self._sequence))
        scale = self._find_scale(mode, observations, T_network)
        factors = self._measure(observations, scale)
        T_odometry = self._dead_reckon(factors, T_network, scale)
        loops = self._close_loops(observations.views, scale, T_odometry)
        graph, T_optimised = self._optimise(factors, loops, T_odometry)
        return SlamResult(
            network=self._trajectory(T_network),
            odometry=self._trajectory(T_odometry),
            optimised=self._trajectory(T_optimised),
            lidar=self._follow_lidar(),
            reference=None if self._sequence.reference is None else self._trajectory(self._sequence.reference),
            observations=observations,
            scale=scale,
            factors=factors,
            loops=loops.without(graph.dropped),
            graph=graph,
            map=None,
            stopwatch=self._watch,
        )

    def fuse(self, estimate: SlamResult) -> TsdfMap | None:
        """Learned depth at the optimised poses, fused into one surface; None where mapping is switched off."""
        keyframes = estimate.observations.keyframes
        if not self._config.mapping.enabled or not keyframes:
            return None
        height, width = keyframes[0].depth_unscaled.shape
        tsdf_map = TsdfMap(self._config.mapping, self._sequence.intrinsics.resized(width, height))
        with self._watch.stage("map"):
            for done, keyframe in enumerate(keyframes):
                metres = keyframe.depth_unscaled * np.float32(estimate.scale.per_frame[keyframe.index])
                T_world_camera = estimate.optimised.T_world_camera[keyframe.index]
                tsdf_map.integrate(metres, keyframe.image, T_world_camera)
                self._progress("map", done + 1, len(keyframes))
        return tsdf_map

    def _require_possible(self) -> ScaleMode:
        """The scale mode of this run; refuses before any work what could only fail after all of it."""
        sequence, shortest = self._sequence, self._predictor.sources + 1
        if len(sequence) < shortest:
            raise SlamError(
                f"{sequence.name} has {len(sequence)} frames, and one snippet of these networks has {shortest}: "
                "choose a longer range"
            )
        mode = resolve_mode(self._config.scale, sequence.camera_height_m)
        if mode == "lidar":
            raise SlamError("scale mode lidar is not built yet: choose camera-height, reference or none")
        if mode == "reference" and sequence.reference is None:
            raise SlamError(
                f"scale mode reference wants true poses; {sequence.name} has none: choose camera-height or none"
            )
        if mode == "camera-height" and sequence.camera_height_m is None:
            raise SlamError(
                f"scale mode camera-height wants a known height; {sequence.name} has none: add camera_height_m "
                "to camera.yaml or choose scale.mode=none"
            )
        return mode

    def _observe(self) -> Observations:
        """One pass over the frames: depth, road, snippet poses and image geometry, as frames arrive."""
        seen = Observations()
        geometry = GeometricOdometry(self._config.geometry, self._sequence.intrinsics)
        features = FeatureExtractor(self._config.loops, self._sequence.intrinsics)
        steps = self._config.geometry.steps if self._config.geometry.enabled else ()
        window: deque[Frame] = deque(maxlen=self._predictor.sources + 1)
        recent: deque[tuple[Frame, DepthMap, float | None]] = deque(maxlen=max(steps, default=0) + 1)
        total = len(self._sequence)
        wanted = set(np.linspace(0, total - 1, EXAMPLES + 2).round().astype(int)[1:-1])
        for index in range(total):
            with self._watch.stage("read"):
                frame = self._sequence.frame(index)
            with self._watch.stage("depth network"):
                depth = self._predictor.depth(frame)
            with self._watch.stage("road"):
                road = fit_road(depth, self._sequence.intrinsics, self._config.scale)
            seen.roads.append(road)
            window.append(frame)
            if len(window) == window.maxlen:
                with self._watch.stage("pose network"):
                    seen.snippets.append(self._predictor.snippet(list(window)))
            height = road.height_unscaled if isinstance(road, RoadPlane) else None
            recent.append((frame, depth, height))
            with self._watch.stage("geometry"):
                self._measure_geometry(geometry, recent, steps, seen)
            if self._config.loops.enabled and index % self._config.loops.frame_stride == 0:
                with self._watch.stage("loops"):
                    seen.views.append(features.view(frame, depth, height))
            self._keep(frame, depth, index in wanted, seen)
            self._progress("frames", index + 1, total)
        return seen

    def _measure_geometry(
        self,
        geometry: GeometricOdometry,
        recent: deque[tuple[Frame, DepthMap, float | None]],
        steps: Sequence[int],
        seen: Observations,
    ) -> None:
        current = recent[-1][0]
        for step in steps:
            if len(recent) <= step:
                continue
            previous, depth_previous, height = recent[-1 - step]
            measured = geometry.relative_pose(previous, current, depth_previous, height)
            if isinstance(measured, Refusal):
                seen.refusals.append((previous.index, current.index, measured.reason))
                logger.info("geometry %d -> %d refused: %s", previous.index, current.index, measured.reason)
            else:
                seen.geometric.append(measured)

    def _keep(self, frame: Frame, depth: DepthMap, as_example: bool, seen: Observations) -> None:
        """Remember thinned frames for the map, and a few whole ones for the report."""
        mapping = self._config.mapping
        if as_example:
            seen.examples.append((frame.index, frame.image, depth))
        if not mapping.enabled or frame.index % mapping.frame_stride:
            return
        height, width = depth.shape
        thinned = min(mapping.width_px / width, 1.0)
        size = (max(round(width * thinned), 1), max(round(height * thinned), 1))
        small = depth if thinned == 1.0 else cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
        image = frame.image if thinned == 1.0 else cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
        seen.keyframes.append(Keyframe(frame.index, image, small))

    def _find_scale(self, mode: ScaleMode, seen: Observations, T_network: FloatArray) -> Scale:
        """The unit of length, as the named mode wants it."""
        config, sequence = self._config.scale, self._sequence
        with self._watch.stage("scale"):
            if mode == "reference" and sequence.reference is not None:
                return self._steady(mode, scale_from_reference(T_network, sequence.reference, config))
            height = sequence.camera_height_m if mode == "camera-height" else None
            estimate = scale_from_road(seen.roads, height, config)
            if isinstance(estimate, Refusal):
                return self._steady(mode, estimate)
            return Scale(mode, estimate, scale_track(seen.roads, height, estimate, config))

    def _steady(self, mode: ScaleMode, estimate: ScaleEstimate | Refusal) -> Scale:
        if isinstance(estimate, Refusal):
            logger.warning("no scale (%s): lengths stay in the networks' unit", estimate.reason)
            return Scale(mode, estimate, np.ones(len(self._sequence)))
        return Scale(mode, estimate, np.full(len(self._sequence), estimate.value))

    def _measure(self, seen: Observations, scale: Scale) -> list[RelativePose]:
        """All relative poses with their noise, in the mode's unit."""
        noise = measured_noise(seen.snippets, seen.geometric, self._config.frontend)
        factors = network_factors(seen.snippets, noise) + seen.geometric
        return [rescaled(f, float(scale.per_frame[min(f.from_index, f.to_index)])) for f in factors]

    def _dead_reckon(self, factors: Sequence[RelativePose], T_network: FloatArray, scale: Scale) -> FloatArray:
        """The front end without a graph: of each step the image geometry, else the network, chained."""
        increments = invert(T_network[:-1]) @ T_network[1:]
        increments[:, :3, 3] *= scale.per_frame[:-1, None]
        for factor in factors:
            if factor.source != NETWORK_SOURCE and factor.to_index - factor.from_index == 1:
                increments[factor.from_index] = factor.T_from_to
        return chain(increments)

    def _close_loops(self, views: Sequence[View], scale: Scale, T_odometry: FloatArray) -> LoopClosures:
        """Places seen before, looked for among all views after the last frame."""
        with self._watch.stage("loops"):
            scaled = [view.scaled(float(scale.per_frame[view.index])) for view in views]
            return close_loops(scaled, T_odometry, self._sequence.intrinsics, self._config.loops)

    def _optimise(
        self, factors: Sequence[RelativePose], loops: LoopClosures, T_odometry: FloatArray
    ) -> tuple[PoseGraph, FloatArray]:
        """The trajectory that explains all measurements best, without the loops that contradict it."""
        graph = PoseGraph(self._config.pose_graph)
        graph.add_relative(*factors, *(loop.measured for loop in loops.accepted))
        with self._watch.stage("graph"):
            T_optimised = graph.optimise(T_odometry)
            while graph.drop_contradicted_loops():
                T_optimised = graph.optimise(T_odometry)
        return graph, T_optimised

    def _follow_lidar(self) -> LidarPath | None:
        """What the LiDAR on the same car measured, as a row to compare with; nothing else looks at it."""
        with self._watch.stage("lidar"):
            return lidar_path(self._sequence)

    def _trajectory(self, T_world_camera: FloatArray) -> Trajectory:
        return Trajectory(self._sequence.stamps, T_world_camera)
