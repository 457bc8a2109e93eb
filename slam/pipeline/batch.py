"""The whole system on one sequence; `SlamPipeline.run` lists its stages."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from erfsfm.pose_noise import PoseNoise
from slam.config import ScaleMode, SlamConfig
from slam.frames import Frame, Predictor, RelativePose
from slam.frames import Sequence as FrameSequence
from slam.frontend.factors import Unscaled, chain_odometry, make_factors
from slam.frontend.failure import MeasurementFailure
from slam.frontend.lidar_odometry import LidarPath, lidar_path, lidar_steps
from slam.frontend.network_factors import chain_raw
from slam.frontend.rotation_smoothing import smooth_rotations
from slam.frontend.scale.metric_scale import LengthMeasurements, Scale, find_scale
from slam.frontend.scale.scale_estimate import (
    ScaleEstimate,
    scale_from_distance,
    scale_from_reference,
)
from slam.geodesy import GpsTrack
from slam.loops.closure import LoopClosures, close_loops
from slam.mapping.map import TsdfMap
from slam.pipeline.checkpoint import SessionCheckpoint
from slam.pipeline.doubts import warn_of_another_place, warn_of_doubts
from slam.pipeline.journal import EVERY_FRAMES, Journal
from slam.pipeline.keyframe_depth import KeyframeDepth, KeyframeDepths
from slam.pipeline.keyframe_tracking import decided
from slam.pipeline.map_closure import close_maps
from slam.pipeline.measurements import Measurements
from slam.pipeline.observations import ClosedObservations, Examples
from slam.pipeline.observer import Observer, ObserverState
from slam.pipeline.positioning import Location, Positioning
from slam.pipeline.reading import read_frame
from slam.pipeline.requirements import require_frames, require_possible
from slam.pipeline.solution import Solution
from slam.pose_graph import PoseGraph
from slam.runtime.imports import import_open3d_beside
from slam.runtime.threads import read_ahead
from slam.runtime.timing import Stopwatch
from slam.se3 import FloatArray
from slam.sequences.continued import Continued
from slam.storage.cache import GetOrCompute, without_cache
from slam.trajectory import Trajectory

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class SlamResult:
    """Trajectories with one row a frame, the graph, the map and the measurements.

    ``state`` is that of the observer, for a run that continues this one; frames before ``first`` are of earlier runs.
    ``location`` is None without a GPS track, and the reason where the track cannot be used.
    """

    network: Trajectory
    odometry: Trajectory
    optimised: Trajectory
    lidar: LidarPath | MeasurementFailure | None
    reference: Trajectory | None
    state: ObserverState
    observations: ClosedObservations
    scale: Scale
    factors: list[RelativePose]
    loops: LoopClosures
    graph: PoseGraph
    map: TsdfMap | None
    stopwatch: Stopwatch
    first: int
    location: Location | MeasurementFailure | None = None


class SlamPipeline:
    """From the frames of a sequence to a trajectory and a map."""

    def __init__(
        self,
        sequence: FrameSequence,
        predictor: Predictor,
        config: SlamConfig,
        progress: Progress | None = None,
        noise: PoseNoise | None = None,
        get_or_compute: GetOrCompute = without_cache,
        checkpoint: SessionCheckpoint | None = None,
        seed: int = 0,
        gps_track: GpsTrack | None = None,
    ) -> None:
        """Prepare a run.

        Args:
            sequence: frames in time order.
            predictor: depth and snippet poses.
            config: of all parts.
            progress: called with the stage, done and total.
            noise: of the snippet poses; None measures it against image geometry alone.
            get_or_compute: a cache of image measurements.
            checkpoint: measurements of the first frames of the sequence, whose images are then not read.
            seed: of all RANSAC draws.
            gps_track: positions of the drive.
        """
        if noise is None:
            logger.info("no noise.yaml beside the weights: the pose network's noise is measured on the drive")
        self._noise = noise
        self._sequence, self._predictor = sequence, predictor
        self._config = decided(config, sequence.camera_height_m)
        self._progress = progress or (lambda stage, done, total: None)
        self._get_or_compute = get_or_compute
        self._checkpoint = checkpoint
        self.first = 0 if checkpoint is None else len(checkpoint.state.seen.roads)  # frames before are measured
        self._seed = seed
        self._gps_track = gps_track
        self._watch = Stopwatch()

    def run(self) -> SlamResult:
        """Run the whole system.

        Raises:
            SlamError: the sequence is too short, unreadable or lacks what the scale mode needs, or the graph has no
                solution.
        """
        estimate = self.estimate()
        return replace(estimate, map=self.fuse(estimate))

    def estimate(
        self,
        journal: Journal | None = None,
        frames: Iterator[Frame] | None = None,
        watch: Callable[[Observer], None] | None = None,
    ) -> SlamResult:
        """Everything but the map, so that trajectories can be kept before fusion begins; raises as ``run``.

        Args:
            journal: keeps the state of the pass, given to it every 100 frames.
            frames: of a sequence that grows as they come; None reads them from the sequence.
            watch: called after every frame.
        """
        mode = self.require_possible() if frames is None else require_possible(self._sequence, self._config, False)
        if self._config.mapping.enabled:
            import_open3d_beside()
        observations, state = self._observe(journal, frames, watch)
        observations = self.close_maps(observations)
        warn_of_doubts(len(self._sequence), observations, state)
        solved = self.solve(mode, observations)
        measured = solved.measured
        return SlamResult(
            network=self._trajectory(measured.T_network),
            odometry=self._trajectory(measured.T_odometry),
            optimised=self._trajectory(solved.T_world_camera),
            lidar=measured.lidar,
            reference=None if self._sequence.reference is None else self._trajectory(self._sequence.reference),
            state=state,
            observations=observations,
            scale=measured.scale,
            factors=measured.factors,
            loops=solved.loops,
            graph=solved.graph,
            map=None,
            stopwatch=self._watch,
            first=self.first,
            location=solved.location,
        )

    def solve(self, mode: ScaleMode, observations: ClosedObservations) -> Solution:
        """Relative poses, loops and the trajectory that fits both; ``SlamError`` where there is none."""
        measured = self.measure(mode, observations)
        loops = self.close_loops(observations, measured)
        graph, T_optimised, location = self._optimise(measured, loops)
        return Solution(measured, loops.without(graph.dropped), graph, T_optimised, location)

    def measure(self, mode: ScaleMode, seen: ClosedObservations) -> Measurements:
        """The front end: rotations, scale and lengths, then all factors and the odometry chained from them."""
        T_network = chain_raw(seen.snippets, len(self._sequence))
        steps = smooth_rotations(seen.steps, seen.relative_rotations)
        with self._watch.stage("lidar"):
            lidar = lidar_path(self._sequence)
        by_lidar = lidar_steps(lidar) if isinstance(lidar, LidarPath) else []
        unscaled = Unscaled(steps, seen.gaps.trusted, seen.gaps.interpolated, seen.window)
        scale = self._find_scale(mode, seen, unscaled, by_lidar, T_network)
        factors = self._factors(unscaled, scale, by_lidar if self._config.lidar.factors and scale.is_metric else [])
        return Measurements(T_network, lidar, scale, factors, chain_odometry(factors, T_network, scale))

    def close_maps(self, seen: ClosedObservations) -> ClosedObservations:
        """The same after loops among the keyframes of all maps."""
        if not seen.maps or not self._config.loops.enabled:
            return seen
        with self._watch.stage("loops"):
            return seen.with_closure(close_maps(seen.maps, self._sequence.intrinsics, self._config, self._seed))

    def close_loops(self, seen: ClosedObservations, measured: Measurements) -> LoopClosures:
        """Loops after the last frame: those of the closed maps, or else among all views."""
        if seen.closure is not None:
            return seen.closure.closures(measured.scale)
        with self._watch.stage("loops"):
            scaled = [view.scaled(float(measured.scale.per_frame[view.index])) for view in seen.views]
            intrinsics, config, is_metric = self._sequence.intrinsics, self._config.loops, measured.scale.is_metric
            return close_loops(scaled, measured.T_odometry, intrinsics, config, is_metric, self._seed)

    def fuse(
        self,
        estimate: SlamResult,
        compare: Callable[[KeyframeDepth], None] | None = None,
        folder: Path | None = None,
    ) -> TsdfMap | None:
        """Learned depth at the optimised poses, refined and fused into one surface; None where mapping is switched off.

        ``compare`` is called with the depth of each keyframe that is far enough from the one before; ``folder`` is
        where finished submaps go, a temporary folder where it is None.
        """
        keyframes = estimate.observations.keyframes
        if not self._config.mapping.enabled or not keyframes:
            return None
        height, width = keyframes[0].depth_unscaled.shape
        intrinsics = self._sequence.intrinsics.resized(width, height)
        T_world_camera = estimate.optimised.T_world_camera
        config = self._config
        scales = estimate.scale.per_frame
        depths = KeyframeDepths(estimate.observations, scales, T_world_camera, intrinsics, config.depth)
        mapping = config.mapping if estimate.scale.is_metric else depths.fitted(config.mapping)
        tsdf_map = TsdfMap(mapping, intrinsics, folder)
        moved = tsdf_map.moved([keyframe.index for keyframe in keyframes], T_world_camera)
        with closing(read_ahead(depths.at, moved)) as ahead:
            for done, keyframe in enumerate(self._watch.each("depth refinement", ahead), 1):
                if compare is not None:
                    compare(keyframe)
                with self._watch.stage("map"):
                    pose, number = T_world_camera[keyframe.index], keyframe.index
                    tsdf_map.integrate(keyframe.best, keyframe.image, pose, keyframe.relative_sigma, number)
                self._progress("map", done, len(moved))
        return tsdf_map

    def require_possible(self) -> ScaleMode:
        """The scale mode of this run, after checks that it can succeed; raises as they do."""
        require_frames(self._sequence, self._predictor.sources + 1)
        mode = require_possible(self._sequence, self._config, self._gps_track is not None)
        self._positioning(mode)
        return mode

    def _positioning(self, mode: ScaleMode) -> Positioning | None:
        """The GPS track matched to the drive, None without one."""
        track = self._gps_track
        return None if track is None else Positioning(track, self._sequence.stamps, self._config.gps, mode)

    def _observe(
        self, journal: Journal | None, frames: Iterator[Frame] | None, watch: Callable[[Observer], None] | None
    ) -> tuple[ClosedObservations, ObserverState]:
        """One pass over the frames, or over those that follow a checkpoint."""
        checkpoint, first, total = self._checkpoint, self.first, len(self._sequence)
        state = None if checkpoint is None else checkpoint.state
        if state is not None and self._config.mapping.enabled and not state.seen.keyframes:
            logger.warning(
                "the map begins at frame %d: no earlier keyframes were kept (see output.keep=keyframes)", first
            )
        examples = Examples(None if frames is not None else range(first, total))
        observer = Observer(
            self._predictor,
            self._sequence.intrinsics,
            self._config,
            self._watch,
            examples,
            self._get_or_compute,
            self._seed,
            state,
        )
        ahead = read_ahead(partial(read_frame, self._sequence), range(first, total))
        with observer, closing(ahead) as read:
            for index, frame in enumerate(self._watch.each("read", frames or read), first):
                observer.add(index, frame)
                if watch is not None:
                    watch(observer)
                self._progress("frames", index + 1, total)
                done = index + 1 - first
                if journal is not None and done % EVERY_FRAMES == 0 and index + 1 < total:
                    with self._watch.stage("journal"):
                        journal.keep(observer.state())
            closed = observer.closed()
            if isinstance(self._sequence, Continued):
                warn_of_another_place(closed, first)
            return closed, observer.state()

    def _find_scale(
        self,
        mode: ScaleMode,
        seen: ClosedObservations,
        unscaled: Unscaled,
        by_lidar: Sequence[RelativePose],
        T_network: FloatArray,
    ) -> Scale:
        """The unit of length by the mode, and the lengths of all steps."""
        config, sequence = self._config, self._sequence
        measured = LengthMeasurements(seen.roads, unscaled.steps.triangulated, seen.road_steps, by_lidar)
        with self._watch.stage("scale"):
            scale = find_scale(mode, sequence.camera_height_m, measured, config.lengths)
            if mode not in ("reference", "known", "gps"):
                return scale
            T_odometry = chain_odometry(self._factors(unscaled, scale, []), T_network, scale)
            return scale.in_metres(self._unit(mode, T_odometry))

    def _unit(self, mode: ScaleMode, T_odometry: FloatArray) -> ScaleEstimate | MeasurementFailure:
        """Metres per unit of an odometry, by what the mode knows of the drive."""
        sequence, config = self._sequence, self._config.scale
        unit: ScaleEstimate | MeasurementFailure = MeasurementFailure(f"nothing is known for scale mode {mode}")
        positioning = self._positioning(mode)
        if mode == "reference" and sequence.reference is not None:
            unit = scale_from_reference(T_odometry, sequence.reference)
        elif mode == "known":
            unit = scale_from_distance(T_odometry, sequence.stamps, config)
        elif positioning is not None:
            unit = positioning.scale(T_odometry)
        return unit

    def _factors(self, unscaled: Unscaled, scale: Scale, by_lidar: Sequence[RelativePose]) -> list[RelativePose]:
        return make_factors(unscaled, scale, by_lidar, self._noise, self._config.frontend, self._config.geometry)

    def _optimise(
        self, measured: Measurements, loops: LoopClosures
    ) -> tuple[PoseGraph, FloatArray, Location | MeasurementFailure | None]:
        """The optimised trajectory without the loops that contradict it, and where it lies on the earth."""
        graph, T_odometry, unit = PoseGraph(self._config.pose_graph), measured.T_odometry, measured.scale.estimate
        graph.add_relative(*measured.factors, *(loop.measured for loop in loops.accepted))
        positioning = self._positioning(measured.scale.mode)
        location = None if positioning is None else positioning.locate(T_odometry, unit)
        if positioning is not None and isinstance(location, Location):
            positioning.add_factors(graph, location, T_odometry)
        with self._watch.stage("graph"):
            T_optimised = graph.optimise(T_odometry)
            while graph.drop_contradicted_loops():
                T_optimised = graph.optimise(T_odometry)
        if positioning is not None and isinstance(location, Location):
            location = positioning.relocated(graph, T_optimised, unit)
        return graph, T_optimised, location

    def _trajectory(self, T_world_camera: FloatArray) -> Trajectory:
        return Trajectory(self._sequence.stamps, T_world_camera)
