"""The system: `SlamPipeline.run` is its table of contents."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from erfsfm.pose_noise import PoseNoise
from slam.config import ScaleMode, SlamConfig
from slam.errors import SlamError
from slam.frames import DepthMap, Image, Predictor, RelativePose, runs
from slam.frames import Sequence as FrameSequence
from slam.frontend.lidar_odometry import LidarPath, has_scans, lidar_path, lidar_steps
from slam.frontend.network_factors import (
    NETWORK_SOURCE,
    calibrated_factors,
    chain_raw,
    measured_noise,
    network_factors,
    without_measured,
)
from slam.frontend.scale.metric_scale import LengthMeasurements, Scale, find_scale
from slam.frontend.scale.road_plane import rescaled, resolve_mode, scale_from_reference
from slam.frontend.visual.relative_rotation import StepRotation, smooth_rotations
from slam.frontend.visual.step_noise import StepNoise, inflate_step_sigmas
from slam.loops.closure import LoopClosures, close_loops
from slam.loops.descriptors import View
from slam.mapping import TsdfMap
from slam.pipeline.checkpoint import SessionCheckpoint
from slam.pipeline.observer import Observations, Observer, read_frame
from slam.pose_graph import PoseGraph
from slam.runtime.imports import import_open3d_beside
from slam.runtime.threads import read_ahead
from slam.runtime.timing import Stopwatch
from slam.se3 import FloatArray, chain, invert
from slam.storage.cache import GetOrCompute, without_cache
from slam.trajectory import Trajectory

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]
EXAMPLES = 5


@dataclass(frozen=True)
class Measurements:
    """All relative poses with their noise, and the trajectories that they chain to ``(N, 4, 4)``."""

    T_network: FloatArray
    lidar: LidarPath | None
    scale: Scale
    factors: list[RelativePose]
    T_odometry: FloatArray


@dataclass(frozen=True)
class SlamResult:
    """Trajectories with one row a frame, the graph, the map and how they came about."""

    network: Trajectory
    odometry: Trajectory
    optimised: Trajectory
    lidar: LidarPath | None
    reference: Trajectory | None
    observer: Observer
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
        self,
        sequence: FrameSequence,
        predictor: Predictor,
        config: SlamConfig,
        progress: Progress | None = None,
        noise: PoseNoise | None = None,
        get_or_compute: GetOrCompute = without_cache,
        drive: SessionCheckpoint | None = None,
    ) -> None:
        """Prepare a run.

        Args:
            sequence: frames in time order.
            predictor: depth and snippet poses.
            config: of all parts.
            progress: told the stage, and how much of it is done.
            noise: of the snippet poses; None measures it against image geometry alone.
            recall: remembers what images alone determine.
            drive: what was seen of the first frames of the sequence, whose images are then not asked for.
        """
        if noise is None:
            logger.info("no noise.yaml beside the weights: the pose network's noise is measured on the drive")
        self._noise = noise
        self._sequence = sequence
        self._predictor = predictor
        self._config = config
        self._progress = progress or (lambda stage, done, total: None)
        self._get_or_compute = get_or_compute
        self._drive = drive
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
        if self._config.mapping.enabled:
            import_open3d_beside()
        observer = self._observe()
        observations = observer.closed()
        for first, last in runs(observations.bridged):
            logger.warning("frames %d to %d bridged: %s", first, last, observations.bridged[first])
        measured = self.measure(mode, observations)
        loops = self.close_loops(observations.views, measured)
        graph, T_optimised = self._optimise(measured.factors, loops, measured.T_odometry)
        return SlamResult(
            network=self._trajectory(measured.T_network),
            odometry=self._trajectory(measured.T_odometry),
            optimised=self._trajectory(T_optimised),
            lidar=measured.lidar,
            reference=None if self._sequence.reference is None else self._trajectory(self._sequence.reference),
            observer=observer,
            observations=observations,
            scale=measured.scale,
            factors=measured.factors,
            loops=loops.without(graph.dropped),
            graph=graph,
            map=None,
            stopwatch=self._watch,
        )

    def measure(self, mode: ScaleMode, observations: Observations) -> Measurements:
        """What the front end makes of the observations: lengths, factors, dead reckoning."""
        T_network = chain_raw(observations.snippets, len(self._sequence))
        observations = _with_smooth_rotations(observations)
        lidar = self._follow_lidar()
        scale = self._find_scale(mode, observations, lidar, T_network)
        factors = self._measure(observations, lidar, scale)
        return Measurements(T_network, lidar, scale, factors, self._dead_reckon(factors, T_network, scale))

    def close_loops(self, views: Sequence[View], measured: Measurements) -> LoopClosures:
        """Places seen before, looked for among all views after the last frame."""
        with self._watch.stage("loops"):
            scaled = [view.scaled(float(measured.scale.per_frame[view.index])) for view in views]
            intrinsics, config = self._sequence.intrinsics, self._config.loops
            return close_loops(scaled, measured.T_odometry, intrinsics, config, self._get_or_compute)

    def fuse(self, estimate: SlamResult) -> TsdfMap | None:
        """Learned depth at the optimised poses, fused into one surface; None where mapping is switched off."""
        keyframes = estimate.observations.keyframes
        if not self._config.mapping.enabled or not keyframes:
            return None
        height, width = keyframes[0].depth_unscaled.shape
        tsdf_map = TsdfMap(self._config.mapping, self._sequence.intrinsics.resized(width, height))

        def read(n: int) -> tuple[DepthMap, Image]:
            metres = keyframes[n].depth_unscaled * np.float32(estimate.scale.per_frame[keyframes[n].index])
            return metres, keyframes[n].image

        with self._watch.stage("map"):
            for done, (metres, image) in enumerate(read_ahead(read, range(len(keyframes)))):
                tsdf_map.integrate(metres, image, estimate.optimised.T_world_camera[keyframes[done].index])
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
        if mode == "lidar" and not has_scans(sequence):
            raise SlamError(
                f"scale mode lidar wants LiDAR scans of neighbouring frames and their calibration; {sequence.name} has "
                "none: choose camera-height, reference or none"
            )
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

    def _observe(self) -> Observer:
        """One pass over the frames, or those that no one has seen yet."""
        first, total = 0 if self._drive is None else len(self._drive.stamps), len(self._sequence)
        examples = np.linspace(first, total - 1, EXAMPLES + 2).round().astype(int)[1:-1].tolist()
        observer = Observer(
            self._predictor, self._sequence.intrinsics, self._config, self._watch, examples, self._get_or_compute
        )
        if self._drive is not None:
            self._drive.resume(observer)
            if self._config.mapping.enabled and not observer.seen.keyframes:
                logger.warning("the map begins at frame %d: nothing for it is kept (output.keep=keyframes does)", first)
        frames = read_ahead(partial(read_frame, self._sequence), range(first, total))
        for index in range(first, total):
            with self._watch.stage("read"):
                frame = next(frames)
            observer.add(index, frame)
            self._progress("frames", index + 1, total)
        return observer

    def _find_scale(self, mode: ScaleMode, seen: Observations, lidar: LidarPath | None, T_network: FloatArray) -> Scale:
        """The unit of length, as the named mode wants it, and the lengths of all steps in it."""
        config, sequence = self._config, self._sequence
        steps = {g.from_index for g in seen.geometric if g.to_index == g.from_index + 1}
        measured = LengthMeasurements(
            seen.roads,
            {step: motion for step, motion in seen.motions.items() if step in steps},
            seen.road_steps,
            [] if lidar is None else lidar_steps(lidar, config.lidar),
        )
        with self._watch.stage("scale"):
            scale = find_scale(mode, sequence.camera_height_m, measured, config.scale, config.lengths, config.lidar)
            if mode != "reference" or sequence.reference is None:
                return scale
            T_odometry = self._dead_reckon(self._measure(seen, None, scale), T_network, scale)
            return scale.in_unit_of(scale_from_reference(T_odometry, sequence.reference, config.scale))

    def _measure(self, seen: Observations, lidar: LidarPath | None, scale: Scale) -> list[RelativePose]:
        """All relative poses with their noise, in the mode's unit."""
        by_corners = {step: m.relative_pose.T_from_to for step, m in seen.motions.items()}
        own = {step: motion.own_noise for step, motion in seen.motions.items()}
        drive = inflate_step_sigmas(by_corners, own, self._config.geometry)
        geometric = [self._with_length(g, seen, scale, drive) for g in seen.geometric]
        networks = self._by_networks(seen, [rescaled(g, 1.0 / _unit_of(g, scale)) for g in geometric])
        use = self._config.frontend.use
        if use == "gaps" or (use == "calibrated" and self._noise is None):
            networks = without_measured(networks, seen.geometric)
        unscaled = [*networks, *seen.interpolated]
        factors = [rescaled(f, _unit_of(f, scale)) for f in unscaled]
        if self._config.lidar.factors and lidar is not None:
            factors += lidar_steps(lidar, self._config.lidar)
        return factors + geometric

    def _by_networks(self, seen: Observations, geometric: Sequence[RelativePose]) -> list[RelativePose]:
        """What the pose network measured, unscaled, with the noise beside its weights or else that of this drive."""
        config = self._config.frontend
        if self._noise is not None:
            return calibrated_factors(seen.trusted, geometric, self._noise, config)
        return network_factors(seen.trusted, measured_noise(seen.trusted, geometric, config))

    def _with_length(
        self, measured: RelativePose, seen: Observations, scale: Scale, drive: Mapping[int, StepNoise]
    ) -> RelativePose:
        """A geometric measurement with its step's length, or by learned depth where the step has none."""
        step = measured.from_index
        if measured.to_index == step + 1 and step in seen.motions and np.isfinite(scale.lengths[step]):
            length, relative_sigma = float(scale.lengths[step]), float(scale.length_sigmas[step])
            relative_correlated_sigma = float(scale.length_correlated_sigmas[step])
            known = seen.motions[step].with_length(length, relative_sigma, relative_correlated_sigma, drive[step])
            return replace(known, student_t_dof=self._config.geometry.student_t_dof)
        return rescaled(measured, _unit_of(measured, scale))

    def _dead_reckon(self, factors: Sequence[RelativePose], T_network: FloatArray, scale: Scale) -> FloatArray:
        """The front end without a graph: of each step the image geometry, else the network, chained."""
        increments = invert(T_network[:-1]) @ T_network[1:]
        increments[:, :3, 3] *= scale.per_frame[:-1, None]
        for factor in factors:
            if factor.source != NETWORK_SOURCE and factor.to_index - factor.from_index == 1:
                increments[factor.from_index] = factor.T_from_to
        return chain(increments)

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


def _unit_of(measured: RelativePose, scale: Scale) -> float:
    """What the networks' unit of length is worth there."""
    return float(scale.per_frame[min(measured.from_index, measured.to_index)])


def _with_smooth_rotations(seen: Observations) -> Observations:
    """The same with turns mended by those across several steps."""
    turns = {
        step: StepRotation(invert(motion.relative_pose.T_from_to)[:3, :3], motion.relative_pose.sigmas[:3])
        for step, motion in seen.motions.items()
    }
    motions = {
        step: seen.motions[step].with_rotation(R)
        for step, R in smooth_rotations(turns, seen.relative_rotations).items()
    }
    geometric = [
        motions[g.from_index].relative_pose if g.to_index == g.from_index + 1 and g.from_index in motions else g
        for g in seen.geometric
    ]
    return replace(seen, motions=motions, geometric=geometric)
