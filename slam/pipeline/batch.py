"""The whole system on one sequence; `SlamPipeline.run` lists its stages."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

from erfsfm.common.progress import Progress, silent
from erfsfm.mvs.refine import Decide
from erfsfm.pose_noise import PoseNoise
from slam.config.sections import SlamConfig
from slam.formats.trajectory import Trajectory
from slam.frames import Frame, Predictor, RelativePose
from slam.frames import Sequence as FrameSequence
from slam.frontend import agreement
from slam.frontend.agreement import Agreement
from slam.frontend.drive import Drive
from slam.frontend.factors import chain_odometry, make_factors, with_lidar
from slam.frontend.failure import MeasurementFailure
from slam.frontend.lidar_odometry import LIDAR_SOURCE, lidar_path, usable_steps
from slam.frontend.network_factors import chain_raw
from slam.frontend.scale.metric_scale import Scale, find_scale, height_by_lidar
from slam.frontend.scale.scale_estimate import (
    ScaleEstimate,
    resolve_mode,
    scale_from_distance,
    scale_from_reference,
)
from slam.frontend.visual.depth_error import DepthError
from slam.geometry.geodesy import GpsTrack
from slam.geometry.se3 import FloatArray
from slam.graph.pose_graph import PoseGraph
from slam.loops.closure import LoopClosures, close_loops
from slam.mapping.depth_refinement import decision
from slam.mapping.filters import KeyframeDepth
from slam.mapping.map import TsdfMap
from slam.pipeline.checkpoint import EVERY_FRAMES, CheckpointWriter, SessionCheckpoint
from slam.pipeline.drive_warnings import warn_of_another_place, warn_of_doubts
from slam.pipeline.estimate import Estimate
from slam.pipeline.front_end_state import FrontEndState
from slam.pipeline.input_checks import require_possible
from slam.pipeline.keyframe_depth import ROOM_SIGMA, KeyframeDepths
from slam.pipeline.map_closure import MapClosure
from slam.pipeline.observer import Observer
from slam.pipeline.positioning import Location, Positioning
from slam.runtime.errors import SequenceError
from slam.runtime.imports import import_open3d_beside
from slam.runtime.threads import CORES, read_ahead
from slam.runtime.timing import Stopwatch
from slam.sequences.continued import Continued

logger = logging.getLogger(__name__)


def read_frame(sequence: FrameSequence, index: int) -> Frame | SequenceError:
    """A frame, or why its image cannot be read."""
    try:
        frame = sequence.frame(index)
        frame.image.setflags(write=False)
        return frame
    except SequenceError as error:
        return error


class SlamPipeline:
    """From the frames of a sequence to a trajectory and a map."""

    def __init__(
        self,
        sequence: FrameSequence,
        predictor: Predictor,
        config: SlamConfig,
        progress: Progress = silent,
        noise: PoseNoise | None = None,
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
            checkpoint: measurements of the first frames of the sequence, whose images are then not read.
            seed: of all RANSAC draws.
            gps_track: positions of the drive.
        """
        if noise is None:
            logger.info("no noise.yaml beside the weights: the pose network's noise is measured on the drive")
        self._noise = noise
        self._sequence, self._predictor, self._config = sequence, predictor, config
        self._progress = progress
        self._checkpoint = checkpoint
        self.first = 0 if checkpoint is None else len(checkpoint.state.drive)  # frames before are measured
        self._seed = seed
        self._gps_track = gps_track
        self.mode = resolve_mode(config.scale, sequence.camera_height_m, gps_track is not None)
        self._watch = Stopwatch()

    def run(self) -> Estimate:
        """Run the whole system.

        Raises:
            SlamError: the sequence is too short, unreadable or lacks what the scale mode needs, or the graph has no
                solution.
        """
        estimate = self.estimate()
        return replace(estimate, map=self.fuse(estimate))

    def estimate(
        self,
        checkpoints: CheckpointWriter | None = None,
        frames: Iterator[Frame] | None = None,
        watch: Callable[[Observer], None] | None = None,
    ) -> Estimate:
        """Everything but the map, so that trajectories can be kept before fusion begins; raises as ``run``.

        Args:
            checkpoints: keeps the state of the pass, given to it every 100 frames.
            frames: of a sequence that grows as they come; None reads them from the sequence.
            watch: called after every frame.
        """
        self.require_possible()
        if self._config.mapping.enabled:
            import_open3d_beside()
        drive, closure, state = self._observe(checkpoints, frames, watch)
        self._progress("loops and graph", 0, 1)
        warn_of_doubts(drive, state.gate)
        estimate = self.solve(drive, closure, state)
        self._progress("loops and graph", 1, 1)
        return estimate

    def solve(self, drive: Drive, closure: MapClosure, state: FrontEndState) -> Estimate:
        """Lengths, factors and loops of a completed drive and its closed maps, and the trajectory that fits them.

        Raises:
            SlamError: the graph has no solution.
        """
        T_network = chain_raw(drive.snippets, len(drive))
        with self._watch.stage("lidar"):
            lidar = lidar_path(self._sequence, self._progress)
        steps = usable_steps(lidar, are_needed=self.mode == "lidar")
        agreements = self._compared(drive, steps, state)
        if any(each.is_wrong for each in agreements if each.source == LIDAR_SOURCE):
            steps = []
        scale, factors, T_odometry = self._measure(drive, T_network, steps, agreements)
        support = None if drive.maps else agreement.frame_support(range(len(drive)), drive.motions)
        needs_road = self._config.road.enabled and scale.unit in ("metres", "camera heights")
        camera = self._sequence.intrinsics
        of_images = agreement.of_images(drive, state.odometry, camera, support, scale.contradicted, needs_road)
        if not drive.maps:
            of_images.append(agreement.of_directions(T_odometry))
        views = [view.scaled(float(scale.per_frame[view.index])) for view in drive.views]
        if drive.maps and self._config.loops.enabled:
            loops = closure.closures(scale)
        else:
            with self._watch.stage("loops"):
                loops = close_loops(views, T_odometry, camera, self._config.loops, scale.is_metric, self._seed)
        graph, T_world_camera, location = self._optimise(scale, factors, T_odometry, loops)
        if self._positioning is not None and self._positioning.agreement is not None:
            by_gps = self._positioning.agreement
            agreements.append(by_gps if by_gps.is_wrong else by_gps.said())  # why it is not used was said
        trusted = [*(each for each in agreements if not each.is_wrong), *of_images]
        reference = self._sequence.reference
        return Estimate(
            network=self._trajectory(T_network),
            odometry=self._trajectory(T_odometry),
            optimised=self._trajectory(T_world_camera),
            lidar=lidar,
            reference=None if reference is None else self._trajectory(reference),
            drive=drive,
            state=state,
            scale=scale,
            factors=factors,
            views=views,
            loops=loops.without(graph.dropped),
            graph=graph,
            location=location,
            first=self.first,
            stopwatch=self._watch,
            agreements=(*agreements, *of_images),
            confidence=agreement.confidence(trusted, scale.is_metric, bool(drive.maps)),
            support=support,
        )

    def _compared(self, drive: Drive, steps: Sequence[RelativePose], state: FrontEndState) -> list[Agreement]:
        """LiDAR and depth from elsewhere beside the images; ``SlamError`` where lengths by LiDAR alone are wrong."""
        by_lidar = [agreement.of_steps(LIDAR_SOURCE, steps, drive.steps.triangulated)]
        if (height := height_by_lidar(steps, drive)) is not None:
            by_lidar.append(agreement.of_height(LIDAR_SOURCE, height, self._sequence.camera_height_m, 0.0))
        found = max(filter(None, by_lidar), key=lambda each: each.sigmas, default=None)
        compared = [] if found is None else [found.required() if self.mode == "lidar" else found.said()]
        source, error = self._config.depth.source, state.odometry.depth_error
        by_depth = None if source == "network" else agreement.of_depth(source, error)
        return compared if by_depth is None else [*compared, by_depth.required()]

    def _measure(
        self, drive: Drive, T_network: FloatArray, by_lidar: Sequence[RelativePose], agreements: list[Agreement]
    ) -> tuple[Scale, list[RelativePose], FloatArray]:
        """Scale and factors of a completed drive, and the odometry ``(N, 4, 4)`` chained from the factors."""
        config = self._config
        with self._watch.stage("scale"):
            scale = find_scale(self.mode, self._sequence.camera_height_m, drive, by_lidar, config.lengths)
        factors = make_factors(drive, scale, self._noise, config.pose_network, config.visual_odometry)
        T_odometry = chain_odometry(factors, T_network, scale)
        if self.mode in ("reference", "known", "gps"):
            unit = self._unit(T_odometry)
            if isinstance(unit, ScaleEstimate) and isinstance(scale.estimate, ScaleEstimate):
                name, height, spread = f"scale.mode={self.mode}", self._sequence.camera_height_m, scale.estimate.spread
                agreements.append(agreement.of_height(name, unit.value, height, spread).required())
            scale = scale.in_metres(unit)
            if isinstance(unit, ScaleEstimate):
                factors = [factor.scaled(unit.value) for factor in factors]
                T_odometry[:, :3, 3] *= unit.value
        if config.lidar.factors and scale.is_metric:
            factors = with_lidar(factors, by_lidar)
            T_odometry = chain_odometry(factors, T_network, scale)
        return scale, factors, T_odometry

    def fuse(
        self,
        estimate: Estimate,
        compare: Callable[[KeyframeDepth], None] | None = None,
        folder: Path | None = None,
    ) -> TsdfMap | None:
        """Learned depth at the optimised poses, refined and fused into one surface; None where mapping is switched off.

        A camera that is carried turns on the spot, where nothing measures learned depth. The error of that over
        distance is known by steps, which measure only the first frames there, and is not taken out.

        ``compare`` is called with the depth of each keyframe that is far enough from the one before; ``folder`` is
        where finished submaps go, a temporary folder where it is None.
        """
        keyframes = estimate.drive.keyframes
        if not self._config.mapping.enabled or not keyframes:
            return None
        height, width = keyframes[0].depth_unscaled.shape
        intrinsics = self._sequence.intrinsics.resized(width, height)
        T_world_camera = estimate.optimised.T_world_camera
        config = self._config
        scales, is_carried = estimate.scale.per_frame, bool(estimate.drive.maps)
        error = DepthError() if is_carried else estimate.state.odometry.depth_error
        guess_sigma = ROOM_SIGMA if is_carried and config.depth.is_learned else None
        depths = KeyframeDepths(estimate.drive, scales, T_world_camera, error, intrinsics, self._decide, guess_sigma)
        mapping = config.mapping if estimate.scale.is_metric else depths.fitted(config.mapping)
        tsdf_map = TsdfMap(mapping, intrinsics, folder)
        selected = tsdf_map.select([keyframe.index for keyframe in keyframes], T_world_camera)
        with closing(read_ahead(depths.at, selected, CORES)) as ahead:
            for done, keyframe in enumerate(self._watch.each("depth refinement", ahead), 1):
                if compare is not None:
                    compare(keyframe)
                with self._watch.stage("map"):
                    tsdf_map.integrate(keyframe)
                self._progress("map", done, len(selected))
        return tsdf_map

    def require_possible(self) -> None:
        """Check that this run can succeed; raises as `input_checks.require_possible` and `Positioning`."""
        shortest = self._predictor.sources + 1
        require_possible(self._sequence, self._config, shortest, self._gps_track is not None)
        _ = self._positioning
        _ = self._decide

    @cached_property
    def _decide(self) -> Decide | None:
        """Between learned and measured depth of the map's keyframes."""
        return decision(self._config.depth) if self._config.mapping.enabled else None

    @cached_property
    def _positioning(self) -> Positioning | None:
        """The GPS track matched to the drive, None without one."""
        track = self._gps_track
        return None if track is None else Positioning(track, self._sequence.stamps, self._config.gps, self.mode)

    def _observe(
        self,
        checkpoints: CheckpointWriter | None,
        frames: Iterator[Frame] | None,
        watch: Callable[[Observer], None] | None,
    ) -> tuple[Drive, MapClosure, FrontEndState]:
        """One pass over the frames, or over those that follow a checkpoint."""
        checkpoint, first, total = self._checkpoint, self.first, len(self._sequence)
        state = None if checkpoint is None else checkpoint.state
        if state is not None and self._config.mapping.enabled and not state.drive.keyframes:
            logger.warning(
                "the map begins at frame %d: no earlier keyframes were kept (see output.keep=keyframes)", first
            )
        observer = Observer(
            self._predictor,
            self._sequence.intrinsics,
            self._config,
            self._watch,
            self._seed,
            state,
            self._sequence.camera_height_m,
        )
        ahead = read_ahead(partial(read_frame, self._sequence), range(first, total))
        with observer, closing(ahead) as read:
            for index, frame in enumerate(self._watch.each("read", frames or read), first):
                observer.add(index, frame)
                if watch is not None:
                    watch(observer)
                self._progress("frames", index + 1, total)
                done = index + 1 - first
                if checkpoints is not None and done % EVERY_FRAMES == 0 and index + 1 != total:
                    with self._watch.stage("journal"):
                        checkpoints.keep(observer.state())
            (drive, closure), state = observer.complete_drive(), observer.state()
        if isinstance(self._sequence, Continued):
            warn_of_another_place(drive, first)
        return drive, closure, state

    def _unit(self, T_odometry: FloatArray) -> ScaleEstimate | MeasurementFailure:
        """Metres per unit of an odometry, by what the mode knows of the drive."""
        sequence = self._sequence
        if self.mode == "reference" and sequence.reference is not None:
            return scale_from_reference(T_odometry, sequence.reference)
        if self.mode == "gps" and self._positioning is not None:
            return self._positioning.scale(T_odometry)
        return scale_from_distance(T_odometry, sequence.stamps, self._config.scale)

    def _optimise(
        self, scale: Scale, factors: Sequence[RelativePose], T_odometry: FloatArray, loops: LoopClosures
    ) -> tuple[PoseGraph, FloatArray, Location | MeasurementFailure | None]:
        """The optimised trajectory without the loops that contradict it, and where it lies on the earth."""
        graph, unit = PoseGraph(self._config.pose_graph), scale.estimate
        graph.add_relative(*factors, *(loop.measured for loop in loops.accepted))
        positioning = self._positioning
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
