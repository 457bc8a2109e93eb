"""One run: the whole system on one sequence. `SlamPipeline.run` and `SlamPipeline.solve` are its table of contents."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import cached_property, partial
from threading import Event

import numpy as np

from erfsfm.common.processes import CORES, read_ahead
from erfsfm.common.progress import Progress, silent
from erfsfm.common.signals import calling_on_signals
from erfsfm.mvs.fusion import DepthFusion
from erfsfm.mvs.refine import Decide
from slam.config.sections import SlamConfig
from slam.formats.trajectory import Trajectory
from slam.frames import Frame, GpsTrack, Predictor, RelativePose, View
from slam.frames import Sequence as FrameSequence
from slam.frontend import agreement
from slam.frontend.agreement import Agreement
from slam.frontend.drive import Drive, warn_of_doubts
from slam.frontend.factors import chain_odometry, make_factors
from slam.frontend.fixed_mask import LEAST_IMAGES, FixedMask, warn_of_fixed
from slam.frontend.gaps import complete_drive
from slam.frontend.gps import GpsFixes, Location
from slam.frontend.keyframes.relative_poses import keyframe_poses
from slam.frontend.lidar_odometry import LIDAR_SOURCE, LidarPath, lidar_path, usable_steps
from slam.frontend.measured import Measured
from slam.frontend.network_motion import chain_raw
from slam.frontend.scale import Scale, ScaleEstimate, find_scale, height_by_lidar
from slam.frontend.scale_mode import require_scans, unit_of
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray
from slam.graph.pose_graph import PoseGraph
from slam.loops.closure import LoopClosures, close_loops
from slam.mapping.depth import KeyframeDepth
from slam.mapping.map import TsdfMap
from slam.mapping.submap import moved_rows
from slam.pipeline.estimate import Estimate, fitted, keyframe_depths
from slam.pipeline.map_closure import MapClosure, close_maps
from slam.pipeline.observer import Observer
from slam.runtime.errors import Failed, SequenceError, SlamError, attempt
from slam.runtime.imports import import_open3d_beside
from slam.runtime.stopwatch import Stopwatch
from slam.sequences.recording import RecordedSequence

logger = logging.getLogger(__name__)
# images by which the part that is fixed to the camera is learned before the first step, and the frames they are from
_IMAGES_AHEAD, _LOOKED_AHEAD = 60, 450
# relative sigma of learned depth in rooms, in the unit of the drive: 90 % of the errors are within 1.645 sigmas
_ROOM_SIGMA = 0.32
_KEYFRAME_ROTATION_DEG = 8.0  # rotation after which a frame is fused, degrees


class Recorder:
    """Is given each result of a run as soon as it is whole; this one keeps nothing."""

    def frame(self, observer: Observer) -> None:
        """After every frame."""

    def trajectory(self, name: str, trajectory: Trajectory) -> None:
        """The reference, the network's chain, odometry: each by its name, before loops are sought."""

    def estimate(self, estimate: Estimate) -> None:
        """Everything but the map."""

    def keyframe(self, keyframe: KeyframeDepth) -> None:
        """The depth of each keyframe that is fused."""

    def map(self, estimate: Estimate | Failed) -> None:
        """The estimate with its map, None where mapping is switched off or no frame has depth; or what cost the map."""


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
            sequence: of the frames.
            predictor: of depth and snippet poses.
            config: all settings.
            progress: is called with a stage, how many steps of it are done, and how many there are.
            seed: of all RANSAC draws.
            gps_track: fixes beside the images, or None.
        """
        self.sequence, self._predictor, self._config = sequence, predictor, config
        self._progress, self._seed, self._gps_track = progress, seed, gps_track
        self._fixes: GpsFixes | None = None  # those of the GPS track during the drive
        self._watch = Stopwatch()
        self._interrupted = Event()

    def run(
        self,
        recorder: Recorder | None = None,
        frames: Iterator[Frame] | None = None,
        interrupt: Callable[[], None] | None = None,
    ) -> Estimate:
        """Run the whole system.

        Args:
            recorder: is given the results.
            frames: of a sequence that grows as they come; None reads them from the sequence.
            interrupt: ends the pass over the frames at the first signal to end; None ends it after the next frame.

        Raises:
            SlamError: the sequence is too short, unreadable or lacks what the scale mode needs.
        """
        recorder = recorder or Recorder()
        self.require_possible()
        if self._config.mapping.enabled:
            import_open3d_beside()
        with calling_on_signals(interrupt or self._interrupted.set):
            measured = self._observe(recorder, frames)
        self._leave_out_unseen(measured)
        self._progress("loops and graph", 0, 1)
        estimate = self.solve(measured, recorder)
        warn_of_doubts(estimate.drive)
        self._progress("loops and graph", 1, 1)
        recorder.estimate(estimate)
        mapped = attempt("the map", lambda: self._mapped(estimate, recorder))
        if isinstance(mapped, Failed):
            recorder.map(mapped)
            return estimate
        return mapped

    def solve(self, measured: Measured, recorder: Recorder) -> Estimate:
        """Lengths, factors and loops of a drive, and the trajectory that fits them.

        An error in the search for loops costs the loops, one in the graph the loops and the graph: the optimised
        trajectory then is the odometry.

        Raises:
            SlamError: no snippet of usable frames, or a source of lengths that contradicts the images.
        """
        true_poses = self.sequence.reference
        reference = None if true_poses is None else self._trajectory(true_poses)
        if reference is not None:
            recorder.trajectory("reference", reference)
        maps = self._maps(measured)
        drive = complete_drive(measured, self._predictor.sources, maps.poses, maps.joins)
        network = self._trajectory(chain_raw(drive.snippets, len(drive)))
        recorder.trajectory("network", network)
        with self._watch.stage("lidar"):
            lidar = lidar_path(self.sequence, self._progress)
        lidar_steps, agreements = self._compared(drive, lidar)
        with self._watch.stage("scale"):
            scale = find_scale(self.unit, drive, lidar_steps)
        scale, factors, by_height = self._in_metres(scale, make_factors(drive, scale))
        agreements += by_height
        if self._config.lidar.factors and scale.is_metric:
            factors += lidar_steps
        T_odometry = chain_odometry(factors, len(drive))
        odometry = self._trajectory(T_odometry)
        recorder.trajectory("odometry", odometry)
        views = [view.scaled(float(scale.per_frame[view.index])) for view in drive.views]
        loops = self._loops(maps, drive, scale, views, T_odometry)
        location = self._located(T_odometry, scale)
        solved = attempt(
            "the pose graph", lambda: self._optimised(factors, loops, T_odometry, location)
        )
        if isinstance(solved, Failed):
            solved = solved, T_odometry, LoopClosures(not_sought=solved.reason), location
        graph, T_optimised, loops, location = solved
        drive = drive.parted(T_optimised)
        agreements, confidence, shape = self._confidence(
            drive, scale, T_odometry, agreements, graph
        )
        return Estimate(
            network=network,
            odometry=odometry,
            optimised=self._trajectory(T_optimised),
            lidar=lidar,
            reference=reference,
            drive=drive,
            scale=scale,
            factors=factors,
            views=views,
            loops=loops,
            graph=graph,
            location=location,
            stopwatch=self._watch,
            agreements=agreements,
            confidence=confidence,
            shape=shape,
        )

    def fuse(self, estimate: Estimate, recorder: Recorder) -> TsdfMap | None:
        """Learned depth at the optimised poses, refined and fused into one surface.

        None where mapping is switched off, or no frame has depth.
        """
        config, drive, watch = self._config, estimate.drive, estimate.stopwatch
        if not config.mapping.enabled or not drive.keyframes:
            return None
        scales, T_world_camera = estimate.scale.per_frame, estimate.optimised.T_world_camera
        height, width = drive.keyframes[0].depth_unscaled.shape
        camera = self.sequence.intrinsics.resized(width, height)
        guess_sigma = _ROOM_SIGMA if drive.by_keyframes and config.depth.is_learned else None
        depth_at = keyframe_depths(drive, scales, T_world_camera, camera, self._decide, guess_sigma)
        is_metric, mapping = estimate.scale.is_metric, config.mapping
        mapping = mapping if is_metric else fitted(mapping, drive, scales)
        tsdf_map = TsdfMap(mapping, camera)
        T_keyframes = T_world_camera[[keyframe.index for keyframe in drive.keyframes]]
        selected = moved_rows(T_keyframes, mapping.keyframe_distance_m, _KEYFRAME_ROTATION_DEG)
        with closing(read_ahead(depth_at, selected, CORES)) as ahead:
            for done, keyframe in enumerate(watch.each("depth refinement", ahead), 1):
                recorder.keyframe(keyframe)
                with watch.stage("map"):
                    tsdf_map.integrate(keyframe)
                self._progress("map", done, len(selected))
        return tsdf_map

    def observer(self) -> Observer:
        """Measures the frames of the sequence, one pass."""
        parts = self._config, self._watch, self._seed, self.sequence.camera_height_m
        return Observer(self._predictor, self.sequence.intrinsics, *parts)

    def require_possible(self) -> None:
        """Check that this run can succeed, and match its GPS track.

        Raises:
            SlamError: too few frames, or the sequence lacks what the configuration needs.
        """
        sequence, shortest, track = self.sequence, self._predictor.sources + 1, self._gps_track
        if 0 < len(sequence) < shortest:
            raise SlamError(
                f"{sequence.name} has {len(sequence)} frames, and one snippet of these networks has {shortest}: "
                "choose a longer range"
            )
        if track is not None:
            self._fixes = GpsFixes(track, sequence.stamps, self._config.gps)
        self.unit = unit_of(self._config.scale, sequence, self._fixes)
        if track is not None and not self.unit.gives_metres:
            raise SlamError(
                "a GPS track is in metres: choose scale.mode=gps with it, or another mode in metres"
            )
        if self._config.lidar.factors:
            require_scans("lidar.factors=true", sequence)
            if not self.unit.gives_metres:
                raise SlamError(
                    f"lidar.factors=true is in metres, and lengths of {sequence.name} are in camera heights: "
                    "choose scale.mode=lidar or give a camera height"
                )
        _ = self._decide

    def _observe(self, recorder: Recorder, frames: Iterator[Frame] | None) -> Measured:
        """One pass over the frames, to its end or until it is interrupted."""
        total = len(self.sequence)
        ahead = read_ahead(partial(read_frame, self.sequence), range(total))
        with self.observer() as observer, closing(ahead) as read:
            if frames is None:
                with self._watch.stage("read"):
                    look_ahead(self.sequence, observer.fixed)
            for index, frame in enumerate(self._watch.each("read", frames or read)):
                observer.add(index, frame)
                recorder.frame(observer)
                self._progress("frames", index + 1, total)
                if self._interrupted.is_set():
                    break
            measured = observer.finish()
            observer.gate.warn()
            warn_of_fixed(measured.fixed)
            return measured

    def _leave_out_unseen(self, measured: Measured) -> None:
        """After an interrupted pass the sequence is what was seen."""
        seen, total = len(measured), len(self.sequence)
        if seen == total:
            return
        if seen <= self._predictor.sources:
            raise SlamError(
                f"interrupted after {seen} frames, before the first snippet of the networks"
            )
        logger.warning("interrupted: the run is of the first %d of %d frames", seen, total)
        assert isinstance(self.sequence, RecordedSequence)  # a live drive is what was seen
        self.sequence = self.sequence.cut(0, seen)
        self.require_possible()

    def _maps(self, measured: Measured) -> MapClosure:
        """Poses by the maps of keyframes, closed by their loops."""
        camera, maps = self.sequence.intrinsics, measured.maps
        with self._watch.stage("geometry"):
            poses = keyframe_poses(maps, camera, self._seed)
        if not (maps and self._config.loops.enabled):
            return MapClosure(poses)
        with self._watch.stage("loops"):
            closed = attempt("loop closure", lambda: close_maps(maps, poses, camera, self._seed))
        if isinstance(closed, Failed):
            return MapClosure(poses, LoopClosures(not_sought=closed.reason))
        return closed

    def _in_metres(
        self, scale: Scale, factors: list[RelativePose]
    ) -> tuple[Scale, list[RelativePose], list[Agreement]]:
        """Scale and factors in the metres that the mode knows of the odometry; else in the unit that they have.

        Also how the camera's height in metres agrees with the stated one, where the road is seen.

        Raises:
            SlamError: it contradicts it.
        """
        if self.unit.metres is None:
            return scale, factors, []
        metres = self.unit.metres(chain_odometry(factors, len(scale.per_frame)))
        if isinstance(metres, Failed):
            logger.warning("no scale (%s): lengths stay in %s", metres.reason, scale.unit)
            return replace(scale, estimate=metres), factors, []
        heights = []
        if isinstance(scale.estimate, ScaleEstimate):
            height = metres.value, self.sequence.camera_height_m, scale.estimate.spread
            heights.append(agreement.of_height(f"scale.mode={self.unit.mode}", *height).required())
        per_frame = metres.value * scale.per_frame
        lengths = {
            ends: length._replace(value=metres.value * length.value)
            for ends, length in scale.lengths.items()
        }
        estimate = replace(metres, value=median(per_frame))
        scale = replace(
            scale, estimate=estimate, per_frame=per_frame, lengths=lengths, unit="metres"
        )
        return scale, [factor.scaled(metres.value) for factor in factors], heights

    def _loops(
        self,
        maps: MapClosure,
        drive: Drive,
        scale: Scale,
        views: Sequence[View],
        T_odometry: FloatArray,
    ) -> LoopClosures:
        """The loops of closed maps, or those among the views of a drive."""
        config = self._config.loops
        if drive.by_keyframes and config.enabled:
            return maps.closures(scale)
        arguments = self.sequence.intrinsics, config, scale.is_metric, self._seed
        with self._watch.stage("loops"):
            loops = attempt("loop closure", lambda: close_loops(views, T_odometry, *arguments))
        return LoopClosures(not_sought=loops.reason) if isinstance(loops, Failed) else loops

    def _located(self, T_odometry: FloatArray, scale: Scale) -> Location | Failed | None:
        """Where an odometry in metres lies on the earth; None without a GPS track."""
        if self._fixes is None:
            return None
        if isinstance(scale.estimate, Failed):
            return scale.estimate
        return self._fixes.locate(T_odometry, self.unit.by_gps)

    def _optimised(
        self,
        factors: Sequence[RelativePose],
        loops: LoopClosures,
        T_odometry: FloatArray,
        location: Location | Failed | None,
    ) -> tuple[PoseGraph | Failed, FloatArray, LoopClosures, Location | Failed | None]:
        """The graph, its trajectory ``(N, 4, 4)``, the loops that agree with it, and where it lies on the earth."""
        graph, in_graph = PoseGraph(), self._config.gps.factors
        graph.add_relative(*factors, *(loop.measured for loop in loops.accepted))
        if isinstance(location, Location) and in_graph:
            positions = location.fixes.at_frames(location.T_enu_world, T_odometry)
            graph.add_positions(*positions, location.T_enu_world)
        with self._watch.stage("graph"):
            T_optimised = graph.optimise(T_odometry)
            while graph.drop_contradicted():
                T_optimised = graph.optimise(T_odometry)
        if isinstance(location, Location) and in_graph:
            location = replace(location, T_enu_world=graph.T_fixed_world)
        elif isinstance(location, Location):
            location = location.fixes.locate(T_optimised, self.unit.by_gps)
        return graph, T_optimised, loops.without(graph.dropped), location

    def _mapped(self, estimate: Estimate, recorder: Recorder) -> Estimate:
        mapped = replace(estimate, map=self.fuse(estimate, recorder))
        recorder.map(mapped)
        return mapped

    def _compared(
        self, drive: Drive, lidar: LidarPath | Failed | None
    ) -> tuple[list[RelativePose], list[Agreement]]:
        """Steps by LiDAR unless the images contradict them, and LiDAR and depth from elsewhere beside the images.

        Raises:
            SlamError: lengths by LiDAR alone, or depth from elsewhere, are wrong.
        """
        steps = usable_steps(lidar, are_needed=self.unit.by_lidar)
        by_lidar = [agreement.of_steps(LIDAR_SOURCE, steps, drive.triangulated)]
        if (height := height_by_lidar(steps, drive)) is not None:
            by_lidar.append(
                agreement.of_height(LIDAR_SOURCE, height, self.sequence.camera_height_m, 0.0)
            )
        worst = max(filter(None, by_lidar), key=lambda each: each.sigmas, default=None)
        compared = (
            [] if worst is None else [worst.required() if self.unit.by_lidar else worst.said()]
        )
        source = self._config.depth.source
        if (
            source != "network"
            and (by_depth := agreement.of_depth(source, drive.measured.depth_error)) is not None
        ):
            compared.append(by_depth.required())
        return [] if worst is not None and worst.is_wrong else steps, compared

    def _confidence(
        self,
        drive: Drive,
        scale: Scale,
        T_odometry: FloatArray,
        by_sources: Sequence[Agreement],
        graph: PoseGraph | Failed,
    ) -> tuple[list[Agreement], float | Failed, float | Failed]:
        """Agreements of all sources and of the images, and what follows from them for the run and its shape."""
        by_sources, camera = list(by_sources), self.sequence.intrinsics
        if self._fixes is not None and (by_gps := self._fixes.agreement) is not None:
            # why it is not used was said
            by_sources.append(by_gps if by_gps.is_wrong else by_gps.said())
        needs_road = scale.unit in ("metres", "camera heights")
        of_images = agreement.of_images(drive, camera, scale.contradicted, needs_road)
        if not drive.by_keyframes:
            of_images.append(agreement.of_directions(T_odometry))
        trusted = [*(each for each in by_sources if not each.is_wrong), *of_images]
        sure = agreement.confidence(
            trusted, scale.is_metric, drive.by_keyframes, camera.focal_sigma
        )
        drift: float | Failed = 0.0
        if drive.by_keyframes:
            drift = graph if isinstance(graph, Failed) else attempt("the drift", graph.drift)
        shape = drift if isinstance(drift, Failed) else agreement.shape_confidence(trusted, drift)
        return [*by_sources, *of_images], sure, shape

    @cached_property
    def _decide(self) -> Decide | None:
        """What decides between learned and measured depth of the map's keyframes; None where it is not refined."""
        is_refined = self._config.mapping.enabled and self._config.depth.refine == "learned"
        return DepthFusion(self._config.depth.fusion).decide if is_refined else None

    def _trajectory(self, T_world_camera: FloatArray) -> Trajectory:
        return Trajectory(self.sequence.stamps, T_world_camera)


def look_ahead(sequence: FrameSequence, fixed: FixedMask) -> None:
    """Learn what is fixed to the camera from images of the first minute, before it spoils the first steps."""
    last = min(len(sequence), _LOOKED_AHEAD) - 1
    if last + 1 < 2 * LEAST_IMAGES:
        return
    for index in np.unique(np.linspace(0, last, _IMAGES_AHEAD).astype(int)).tolist():
        frame = read_frame(sequence, index)
        if isinstance(frame, Frame):
            fixed.look_at(frame.grey, frame.fixed)


def read_frame(sequence: FrameSequence, index: int) -> Frame | SequenceError:
    """A frame, or why its image cannot be read."""
    try:
        frame = sequence.frame(index)
        frame.image.setflags(write=False)
        return frame
    except SequenceError as error:
        return error
