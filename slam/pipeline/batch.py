"""The whole system on one sequence; `SlamPipeline.run` lists its stages."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import cached_property, partial

from erfsfm.common.progress import Progress, silent
from erfsfm.mvs.refine import Decide
from slam.config.sections import SlamConfig
from slam.formats.trajectory import Trajectory
from slam.frames import Frame, Predictor, RelativePose
from slam.frames import Sequence as FrameSequence
from slam.frontend import agreement
from slam.frontend.agreement import Agreement
from slam.frontend.drive import Drive
from slam.frontend.factors import chain_odometry, make_factors, with_lidar
from slam.frontend.failure import MeasurementFailure
from slam.frontend.gap_interpolation import complete_drive
from slam.frontend.keyframes.relative_poses import keyframe_poses
from slam.frontend.lidar_odometry import LIDAR_SOURCE, lidar_path, usable_steps
from slam.frontend.network_factors import chain_raw
from slam.frontend.scale.metric_scale import find_scale, height_by_lidar
from slam.frontend.scale.scale_estimate import (
    ScaleEstimate,
    resolve_mode,
    scale_from_distance,
    scale_from_reference,
)
from slam.geometry.geodesy import GpsTrack
from slam.geometry.se3 import FloatArray
from slam.graph.pose_graph import PoseGraph
from slam.loops.closure import LoopClosures, close_loops
from slam.mapping.depth_refinement import decision
from slam.mapping.filters import KeyframeDepth
from slam.mapping.map import TsdfMap
from slam.pipeline.drive_warnings import warn_of_doubts
from slam.pipeline.estimate import Estimate
from slam.pipeline.fusion import fuse
from slam.pipeline.input_checks import require_possible
from slam.pipeline.map_closure import MapClosure, close_maps
from slam.pipeline.observations import Observations
from slam.pipeline.observer import Observer
from slam.pipeline.odometry import Keep, Odometry, Solution, keep_nothing
from slam.pipeline.pending import read_frame
from slam.pipeline.positioning import Location, Positioning
from slam.runtime.attempt import attempt
from slam.runtime.imports import import_open3d_beside
from slam.runtime.storage.record import Missing
from slam.runtime.threads import read_ahead
from slam.runtime.timing import Stopwatch

logger = logging.getLogger(__name__)


class SlamPipeline:
    """From the frames of a sequence to a trajectory and a map."""

    def __init__(
        self,
        sequence: FrameSequence,
        predictor: Predictor,
        config: SlamConfig,
        progress: Progress = silent,
        seed: int = 0,
        gps_track: GpsTrack | None = None,
    ) -> None:
        """Prepare a run.

        Args:
            sequence: frames in time order.
            predictor: depth and snippet poses.
            config: of all parts.
            progress: called with the stage, done and total.
            seed: of all RANSAC draws.
            gps_track: positions of the drive.
        """
        self._sequence, self._predictor, self._config = sequence, predictor, config
        self._progress = progress
        self._seed = seed
        self._gps_track = gps_track
        self.mode = resolve_mode(config.scale, sequence.camera_height_m, gps_track is not None)
        self._watch = Stopwatch()

    def run(self) -> Estimate:
        """Run the whole system.

        Raises:
            SlamError: the sequence is too short, unreadable or lacks what the scale mode needs.
        """
        estimate = self.estimate()
        return replace(estimate, map=self.fuse(estimate))

    def estimate(
        self,
        frames: Iterator[Frame] | None = None,
        watch: Callable[[Observer], None] | None = None,
        keep: Keep = keep_nothing,
    ) -> Estimate:
        """Everything but the map, so that trajectories can be kept before fusion begins; raises as ``run``.

        Args:
            frames: of a sequence that grows as they come; None reads them from the sequence.
            watch: called after every frame.
            keep: as in `solve`.
        """
        self.require_possible()
        if self._config.mapping.enabled:
            import_open3d_beside()
        observed = self._observe(frames, watch)
        self._progress("loops and graph", 0, 1)
        estimate = self.solve(observed, keep)
        warn_of_doubts(estimate.drive, observed.gate)
        self._progress("loops and graph", 1, 1)
        return estimate

    def solve(self, observed: Observations, keep: Keep = keep_nothing) -> Estimate:
        """Lengths, factors and loops of a drive, and the trajectory that fits them.

        An error in the search for loops costs the loops, one in the graph the loops and the graph: the optimised
        trajectory then is the odometry.

        Args:
            observed: all measurements.
            keep: given each trajectory by its name as soon as it is known: all but the last before loops are sought.

        Raises:
            SlamError: no snippet of usable frames, or a source of lengths that contradicts the images.
        """
        if (reference := self._reference) is not None:
            keep("reference", reference)
        with self._watch.stage("geometry"):
            poses = keyframe_poses(observed.maps, self._sequence.intrinsics, self._seed)
        drive = self._completed(observed, MapClosure(poses))
        T_network = chain_raw(drive.snippets, len(drive))
        keep("network", self._trajectory(T_network))
        odometry = self._measured(drive, T_network, observed)
        keep("odometry", self._trajectory(odometry.T_world_camera))
        with self._watch.stage("loops"):
            found = attempt("loop closure", lambda: self._closed(odometry, observed))
        odometry, loops = (odometry, LoopClosures(not_sought=found.reason)) if isinstance(found, Missing) else found
        at = odometry.T_world_camera, odometry.scale.estimate
        location = None if self._positioning is None else self._positioning.locate(*at)
        solved = attempt("the pose graph", lambda: self._optimised(odometry, loops, location))
        if isinstance(solved, Missing):
            solved = Solution(solved, odometry.T_world_camera, LoopClosures(not_sought=solved.reason), location)
        return self._estimate(observed, odometry, solved)

    def _estimate(self, observed: Observations, odometry: Odometry, solved: Solution) -> Estimate:
        """All of it, with what follows for its confidence."""
        drive, scale, by_sources = odometry.drive, odometry.scale, list(odometry.agreements)
        if self._positioning is not None and self._positioning.agreement is not None:
            by_gps = self._positioning.agreement
            by_sources.append(by_gps if by_gps.is_wrong else by_gps.said())  # why it is not used was said
        support = None if drive.maps else agreement.frame_support(range(len(drive)), drive.motions)
        needs_road = self._config.road.enabled and scale.unit in ("metres", "camera heights")
        camera = self._sequence.intrinsics
        of_images = agreement.of_images(drive, observed.odometry, camera, support, scale.contradicted, needs_road)
        if not drive.maps:
            of_images.append(agreement.of_directions(odometry.T_world_camera))
        trusted = [*(each for each in by_sources if not each.is_wrong), *of_images]
        return Estimate(
            network=self._trajectory(odometry.T_network),
            odometry=self._trajectory(odometry.T_world_camera),
            optimised=self._trajectory(solved.T_world_camera),
            lidar=odometry.lidar,
            reference=self._reference,
            drive=drive,
            depth_error=observed.odometry.depth_error,
            scale=scale,
            factors=odometry.factors,
            views=odometry.views(),
            loops=solved.loops,
            graph=solved.graph,
            location=solved.location,
            stopwatch=self._watch,
            agreements=(*by_sources, *of_images),
            confidence=agreement.confidence(trusted, scale.is_metric, bool(drive.maps)),
            support=support,
        )

    def _completed(self, observed: Observations, closure: MapClosure) -> Drive:
        """The drive with its gaps interpolated and the poses of its maps."""
        events = [*observed.events, *closure.joins]
        return complete_drive(observed.drive, self._predictor.sources, observed.maps, closure.poses, events)

    def _closed(self, odometry: Odometry, observed: Observations) -> tuple[Odometry, LoopClosures]:
        """The loops of a drive, and its odometry, which that of closed maps replaces."""
        camera, config, seed = self._sequence.intrinsics, self._config.loops, self._seed
        if not (observed.maps and config.enabled):
            views, is_metric = odometry.views(), odometry.scale.is_metric
            return odometry, close_loops(views, odometry.T_world_camera, camera, config, is_metric, seed)
        closure = close_maps(observed.maps, odometry.drive.map_poses, camera, seed)
        if closure.loops.accepted:
            odometry = self._chained(replace(odometry, drive=self._completed(observed, closure)))
        return odometry, closure.closures(odometry.scale)

    def _compared(self, drive: Drive, steps: Sequence[RelativePose], observed: Observations) -> list[Agreement]:
        """LiDAR and depth from elsewhere beside the images; ``SlamError`` where lengths by LiDAR alone are wrong."""
        by_lidar = [agreement.of_steps(LIDAR_SOURCE, steps, drive.steps.triangulated)]
        if (height := height_by_lidar(steps, drive)) is not None:
            by_lidar.append(agreement.of_height(LIDAR_SOURCE, height, self._sequence.camera_height_m, 0.0))
        found = max(filter(None, by_lidar), key=lambda each: each.sigmas, default=None)
        compared = [] if found is None else [found.required() if self.mode == "lidar" else found.said()]
        source, error = self._config.depth.source, observed.odometry.depth_error
        by_depth = None if source == "network" else agreement.of_depth(source, error)
        return compared if by_depth is None else [*compared, by_depth.required()]

    def _measured(self, drive: Drive, T_network: FloatArray, observed: Observations) -> Odometry:
        """Lengths, factors and odometry of a completed drive."""
        with self._watch.stage("lidar"):
            lidar = lidar_path(self._sequence, self._progress)
        steps = usable_steps(lidar, are_needed=self.mode == "lidar")
        agreements = self._compared(drive, steps, observed)
        if any(each.is_wrong for each in agreements if each.source == LIDAR_SOURCE):
            steps = []
        with self._watch.stage("scale"):
            scale = find_scale(self.mode, self._sequence.camera_height_m, drive, steps, self._config.lengths)
        return self._chained(Odometry(drive, T_network, lidar, steps, scale, [], T_network, tuple(agreements)))

    def _chained(self, odometry: Odometry) -> Odometry:
        """The same with the factors of its drive, chained, in the unit of the mode: of closed maps it is found anew."""
        config, drive, scale, agreements = self._config, odometry.drive, odometry.scale, odometry.agreements
        factors = make_factors(drive, scale, config.visual_odometry)
        T_odometry = chain_odometry(factors, len(drive))
        if self.mode in ("reference", "known", "gps"):
            unit = self._unit(T_odometry)
            if isinstance(unit, ScaleEstimate) and isinstance(scale.estimate, ScaleEstimate) and not scale.is_metric:
                name, height, spread = f"scale.mode={self.mode}", self._sequence.camera_height_m, scale.estimate.spread
                agreements += (agreement.of_height(name, unit.value, height, spread).required(),)
            scale = scale.in_metres(unit)
            if isinstance(unit, ScaleEstimate):
                factors = [factor.scaled(unit.value) for factor in factors]
                T_odometry[:, :3, 3] *= unit.value
        if config.lidar.factors and scale.is_metric:
            factors = with_lidar(factors, odometry.lidar_steps)
            T_odometry = chain_odometry(factors, len(drive))
        return replace(odometry, scale=scale, factors=factors, T_world_camera=T_odometry, agreements=agreements)

    def fuse(
        self,
        estimate: Estimate,
        compare: Callable[[KeyframeDepth], None] | None = None,
    ) -> TsdfMap | None:
        """The map, as `fusion.fuse`; None where mapping is switched off, or no frame has depth."""
        if not self._config.mapping.enabled or not estimate.drive.keyframes:
            return None
        camera, progress = self._sequence.intrinsics, self._progress
        return fuse(estimate, camera, self._config, self._decide, compare, progress)

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

    def _observe(self, frames: Iterator[Frame] | None, watch: Callable[[Observer], None] | None) -> Observations:
        """One pass over the frames."""
        total = len(self._sequence)
        parts = self._config, self._watch, self._seed, self._sequence.camera_height_m
        observer = Observer(self._predictor, self._sequence.intrinsics, *parts)
        ahead = read_ahead(partial(read_frame, self._sequence), range(total))
        with observer, closing(ahead) as read:
            for index, frame in enumerate(self._watch.each("read", frames or read)):
                observer.add(index, frame)
                if watch is not None:
                    watch(observer)
                self._progress("frames", index + 1, total)
            return observer.observations()

    def _unit(self, T_odometry: FloatArray) -> ScaleEstimate | MeasurementFailure:
        """Metres per unit of an odometry, by what the mode knows of the drive."""
        sequence = self._sequence
        if self.mode == "reference" and sequence.reference is not None:
            return scale_from_reference(T_odometry, sequence.reference)
        if self.mode == "gps" and self._positioning is not None:
            return self._positioning.scale(T_odometry)
        return scale_from_distance(T_odometry, sequence.stamps, self._config.scale)

    def _optimised(
        self, odometry: Odometry, loops: LoopClosures, location: Location | MeasurementFailure | None
    ) -> Solution:
        """The most likely trajectory without the loops that contradict it, and where it lies on the earth."""
        graph, positioning = PoseGraph(self._config.pose_graph), self._positioning
        T_odometry = odometry.T_world_camera
        graph.add_relative(*odometry.factors, *(loop.measured for loop in loops.accepted))
        if positioning is not None and isinstance(location, Location):
            positioning.add_factors(graph, location, T_odometry)
        with self._watch.stage("graph"):
            T_optimised = graph.optimise(T_odometry)
            while graph.drop_contradicted_loops():
                T_optimised = graph.optimise(T_odometry)
        if positioning is not None and isinstance(location, Location):
            location = positioning.relocated(graph, T_optimised, odometry.scale.estimate)
        return Solution(graph, T_optimised, loops.without(graph.dropped), location)

    @property
    def _reference(self) -> Trajectory | None:
        reference = self._sequence.reference
        return None if reference is None else self._trajectory(reference)

    def _trajectory(self, T_world_camera: FloatArray) -> Trajectory:
        return Trajectory(self._sequence.stamps, T_world_camera)
