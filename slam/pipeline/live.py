"""Live sessions: the measurements of the pipeline frame by frame, and the whole drive solved on request.

Poses of the newest frames have a cost that does not grow with the drive.
"""

from __future__ import annotations

import logging
import tempfile
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

import numpy as np

from erfsfm.common.readers.camera_file import HIGHEST_M, impossible
from slam.config.sections import SlamConfig
from slam.formats.trajectory import Trajectory
from slam.frames import Frame, Image, Intrinsics, Predictor
from slam.frontend.drive import Drive
from slam.frontend.factors import chain_odometry, make_factors
from slam.frontend.gaps import complete_drive
from slam.frontend.measured import Measured
from slam.frontend.scale import Scale, Unit, find_scale
from slam.geometry.se3 import FloatArray, apply, compose, in_unit, invert
from slam.loops.closure import LoopClosures
from slam.loops.places import PlaceStructure
from slam.loops.verification import OF_KEYFRAMES
from slam.pipeline.estimate import Estimate
from slam.pipeline.observer import Observer
from slam.pipeline.run import Recorder, SlamPipeline
from slam.prediction.assembly import open_prediction
from slam.runtime.errors import Failed, SlamError
from slam.runtime.files import MAP_MESH
from slam.runtime.imports import import_open3d
from slam.sequences.recording import POSSIBLE_PERIODS_S, GrowingSequence

T = TypeVar("T")

_WINDOW, _UPDATE = 100, 10  # frames whose poses are solved again, and between two solutions
State = Literal["starting", "tracking", "bridged", "relocalised"]


@dataclass(frozen=True)
class LivePose:
    """A frame's pose ``(4, 4)``; ``unit`` is that of the pose over that of learned depth, None while unknown.

    ``support`` is the share of the corners that fit the motion to it; None of the first frame, and where a map of
    keyframes gives the pose.
    """

    frame: int
    T_world_camera: FloatArray
    state: State
    unit: float | None
    support: float | None


class LivePoses:
    """Poses from the measurements of the last 100 frames; older poses stay as they are.

    Lengths of all steps in this window are solved again every tenth frame, in between the newest step is scaled as
    the last one was. Where keyframes measure the camera, only their unit is solved again; where they have lost it, only
    what follows the last frame that they located.
    """

    def __init__(self, sources: int, metric: Unit) -> None:
        """Prepare for the first frame, by the ``sources`` of a snippet and the unit of the run."""
        self._sources, self._metric = sources, metric
        self.unit_name: str | None = None  # of all lengths, None while unknown
        self._T_world_camera: list[FloatArray] = []
        self._unit: float | None = None  # of the mode per unscaled length, at the newest frame
        self._was_bridged = False
        self._settled = 0  # the last frame whose pose is by keyframes, or by the whole drive

    @property
    def T_world_camera(self) -> FloatArray:
        """Poses of all frames ``(N, 4, 4)``, at one place before the first snippet, while there is no unit."""
        T_world_camera = np.array(self._T_world_camera).reshape(-1, 4, 4)
        if self._unit is None:
            T_world_camera[:, :3, 3] = 0.0
        return T_world_camera

    @property
    def unit(self) -> float:
        """Of the poses over that of learned depth, at the newest frame; 1 while unknown."""
        return self._unit or 1.0

    def add(self, observer: Observer) -> list[LivePose]:
        """The frames that the observer has finished since the last call."""
        measured = observer.measured
        first, count = len(self._T_world_camera), len(measured)
        frames = range(first, count)
        supports = [self._step(observer, index) for index in frames]
        if measured.snippets and (self._unit is None or count // _UPDATE > first // _UPDATE):
            self._solve(observer, count)
        unit = None if self.unit_name is None else self._unit
        poses: list[LivePose] = []
        for index, pose, support in zip(frames, self._T_world_camera[first:], supports):
            state = self._state(index in measured.unusable)
            poses.append(LivePose(index, pose.copy(), state, unit, support))
        return poses

    def correct(self, T_world_camera: FloatArray, scale: Scale) -> None:
        """Go on from the poses ``(N, 4, 4)`` and the unit of a whole drive."""
        self._T_world_camera, self._unit = list(T_world_camera), float(scale.per_frame[-1])
        self.unit_name = scale.unit_name
        self._settled = max(len(T_world_camera) - 1, 0)

    def _state(self, is_bridged: bool) -> State:
        before, self._was_bridged = self._was_bridged, is_bridged
        if self.unit_name is None:
            return "starting"
        return "bridged" if is_bridged else "relocalised" if before else "tracking"

    def _step(self, observer: Observer, index: int) -> float | None:
        """Append the pose of a frame by its own step, or by the last one again; its support, as in a `LivePose`."""
        if not index:
            self._T_world_camera.append(np.eye(4))
            return None
        before, by_keyframes, motion = (
            index - 1,
            observer.tracker.pose(index),
            observer.measured.last_step(index),
        )
        T_before_frame = None
        if by_keyframes is not None:
            before, T_before_frame = by_keyframes
            self._settled = index
        elif motion is not None and motion.ends[0] == before:
            T_before_frame = motion.relative_pose.T_from_to
        if T_before_frame is not None:
            T_before_frame = in_unit(T_before_frame, self.unit)
        else:  # the camera goes on as it went
            T_before_frame = (
                invert(self._T_world_camera[max(before - 1, 0)]) @ self._T_world_camera[before]
            )
        self._T_world_camera.append(compose(self._T_world_camera[before], T_before_frame))
        if by_keyframes is not None:
            return None
        return 0.0 if motion is None else motion.support

    def _solve(self, observer: Observer, count: int) -> None:
        """Poses of the window by its own measurements, from its first one on, or from the last settled one on."""
        first = max(count - _WINDOW, 0)
        measured = _window(observer.measured, first)
        if not measured.snippets:
            return
        by_keyframes = observer.tracker.pose(count - 1) is not None
        # keyframes know all lengths but their unit, which learned depth of the ground gives
        roads_alone = Drive(Measured(roads=measured.roads))
        window = roads_alone if by_keyframes else complete_drive(measured, self._sources)
        scale = find_scale(self._metric, window)
        self.unit_name = scale.unit_name
        unit = float(np.median(scale.per_frame) if by_keyframes else scale.per_frame[-1])
        if self._unit is None:
            for T in self._T_world_camera:
                T[:3, 3] *= unit
        self._unit = unit
        if by_keyframes:
            return
        T_odometry = chain_odometry(make_factors(window, scale, level=logging.DEBUG), len(window))
        kept = max(first, self._settled)
        T_window_camera = T_odometry[kept - first :]
        T_world_window = self._T_world_camera[kept] @ invert(T_window_camera[0])
        self._T_world_camera[kept + 1 :] = list(T_world_window @ T_window_camera[1:])


class Slam:
    """Monocular SLAM frame by frame; it keeps no images, unless a map is wanted.

    Poses come from the measurements of the last 100 frames; older ones stay, so a frame costs the same however long
    the drive is. `close_loops` solves the whole drive as `run` does. A session is of one thread.
    """

    def __init__(
        self,
        predictor: Predictor,
        intrinsics: Intrinsics,
        config: SlamConfig | None = None,
        camera_height_m: float | None = None,
        with_map: bool = False,
        seed: int = 0,
    ) -> None:
        """Prepare for the first frame.

        Args:
            predictor: depth and snippet poses; ``config.depth`` is read by `from_weights` alone.
            intrinsics: of all images.
            config: None for the defaults; ``mapping.enabled`` has no effect.
            camera_height_m: above the road; None where unknown, then lengths are in camera heights.
            with_map: keep images on disk, for `surface` and `clouds`.
            seed: of all RANSAC draws.

        Raises:
            SlamError: a scale mode that needs more than images, or an impossible camera.
        """
        _require_possible(intrinsics, camera_height_m)
        config = config or SlamConfig()
        mapping = config.mapping.model_copy(update={"enabled": with_map})
        config = config.model_copy(update={"mapping": mapping})
        self._sequence = GrowingSequence(intrinsics, camera_height_m)
        self._pipeline = SlamPipeline(self._sequence, predictor, config, seed=seed)
        self._pipeline.require_possible()
        self._observer = self._pipeline.observer()
        self._is_closed = False
        self._poses = LivePoses(predictor.sources, self._pipeline.unit)
        self._newest = LivePose(0, np.eye(4), "starting", None, None)
        self._estimate: Estimate | None = None

    @classmethod
    def from_weights(
        cls,
        name_or_dir: str | Path,
        intrinsics: Intrinsics,
        config: SlamConfig | None = None,
        camera_height_m: float | None = None,
        device: str = "cpu",
        with_map: bool = False,
    ) -> Slam:
        """With a shipped model by name or a training output folder; depth is that of ``config.depth``.

        Args:
            name_or_dir: a shipped model, or a training output folder.
            intrinsics: of all images.
            config: None for the defaults.
            camera_height_m: above the road, metres; None where unknown.
            device: auto, cpu or cuda.
            with_map: keep images on disk, for `surface` and `clouds`.

        Raises:
            SlamError: as the constructor; a depth source that cannot be opened, or a folder of files.
            ErfsfmError: as ``DepthPosePredictor.from_weights``.
        """
        _require_possible(intrinsics, camera_height_m)
        predictor, *_ = open_prediction(
            name_or_dir, device, (config or SlamConfig()).depth, intrinsics
        )
        return cls(predictor, intrinsics, config, camera_height_m, with_map=with_map)

    def __len__(self) -> int:
        """Number of frames so far."""
        return len(self._sequence)

    @property
    def unit_name(self) -> str | None:
        """Of the lengths of `trajectory`: ``m``, ``camera heights``, ``no metric unit`` or ``the networks' own unit``.

        None before the first snippet and, where metres are wanted, until a road is seen: lengths are the networks' own
        up to then.
        """
        return self._poses.unit_name

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Finish every frame so far and end the threads; results stay available."""
        self._is_closed = True
        try:
            self._observer.flush()
        finally:
            self._observer.close()

    def add_frame(self, image: Image, stamp: float) -> LivePose:
        """Process the next frame; the newest one that is finished, which may be the one before, is returned.

        Args:
            image: ``(H, W, 3)`` uint8 RGB at the size of the intrinsics.
            stamp: seconds, after that of the frame before.

        Raises:
            ValueError: another size, type or order.
            SlamError: the session is closed.
        """
        if self._is_closed:
            raise SlamError("this session is closed: make another Slam")
        size, shape = (
            (self._sequence.intrinsics.height, self._sequence.intrinsics.width, 3),
            np.shape(image),
        )
        if shape != size or image.dtype != np.uint8:
            raise ValueError(
                f"image must be {size} uint8; got {shape} {getattr(image, 'dtype', type(image).__name__)}"
            )
        since = stamp - self._sequence.stamps[-1] if len(self) else POSSIBLE_PERIODS_S[1]
        if not (np.isfinite(stamp) and 0 < since <= POSSIBLE_PERIODS_S[1]):
            raise ValueError(
                f"stamps must increase, in seconds; got {stamp} after {self._sequence.stamps[-1:]}"
            )
        image = image.copy()  # used again with the next one
        image.setflags(write=False)
        index = len(self)
        try:
            self._observer.add(index, Frame(index, stamp, image))
        finally:  # the error may be of the frame before
            if self._observer.frames > index:
                self._sequence.stamps = np.append(self._sequence.stamps, stamp)
        self._newest = (self._poses.add(self._observer) or [self._newest])[-1]
        return self._newest

    def trajectory(self) -> Trajectory:
        """All frames so far, lengths in `unit_name`; before the first snippet the camera is assumed to stay in place.

        Raises:
            SlamError: no frame yet.
        """
        if not len(self):
            raise SlamError("no trajectory before the first frame")
        self._observer.flush()
        self._poses.add(self._observer)
        return Trajectory(self._sequence.stamps.copy(), self._poses.T_world_camera)

    def close_loops(self) -> LoopClosures:
        """Solve the whole drive so far with its loops, as ``run`` does; later frames go on from its poses.

        Raises:
            SlamError: as `SlamPipeline.solve`.
        """
        self._observer.flush()
        if not self._observer.measured.snippets:
            return LoopClosures(not_sought="there are too few usable frames")
        estimate = self._pipeline.solve(self._observer.finish(), Recorder())
        self._poses.correct(estimate.optimised.T_world_camera, estimate.scale)
        self._estimate = estimate
        return estimate.loops

    def keyframes(self) -> Trajectory:
        """The frames whose corners `points` gives; the whole drive so far is solved first, as by `close_loops`.

        Raises:
            SlamError: there are too few usable frames; as `SlamPipeline.solve`.
        """
        estimate = self._solved()
        return estimate.optimised.select(np.array([view.index for view in estimate.views], np.intp))

    def points(self) -> FloatArray:
        """Points ``(M, 3)`` of the corners of `keyframes` in the world, in `unit_name`.

        Those of a hand-held camera are triangulated among neighbouring keyframes, those of a drive have learned depth.

        Raises:
            SlamError: as `keyframes`.
        """
        estimate = self._solved()
        places = estimate.places(self._sequence.intrinsics)
        if estimate.drive.by_keyframes:
            structure = PlaceStructure(places, OF_KEYFRAMES)
            of_views = [structure.points(row, learned=False) for row in range(len(places.views))]
        else:
            pairs = zip(places.T_world_camera, places.views, strict=True)
            of_views = [apply(T, view.points.astype(np.float64)) for T, view in pairs]
        points = np.concatenate(of_views)
        return points[np.isfinite(points).all(axis=1)]

    def marginals(self, frame: int) -> FloatArray:
        """Covariance ``(6, 6)`` of a frame's pose, as `PoseGraph.marginal`.

        Args:
            frame: its number, from 0.

        Raises:
            SlamError: as `keyframes`; the drive has no graph, or no such frame.
        """
        graph = self._solved().graph
        if isinstance(graph, Failed):
            raise SlamError(graph.reason)
        return graph.marginal(frame)

    def surface(self) -> Any:
        """The map of the drive so far as an Open3D ``TriangleMesh``, y down; raises as `keyframes`.

        Raises:
            SlamError: the session was made without ``with_map``, or nothing was seen often enough.
        """
        fused = self._pipeline.fuse(self._solved(), Recorder())
        if fused is None:
            raise SlamError("this session keeps no images: make Slam with with_map=True")
        with tempfile.TemporaryDirectory(prefix="erfsfm-slam-surface-") as folder:
            fused.surface().write_mesh(Path(folder) / MAP_MESH)
            return import_open3d().io.read_triangle_mesh(str(Path(folder) / MAP_MESH))

    def clouds(self, first: int = 0, stride: int = 4) -> dict[int, FloatArray]:
        """Learned depth of each frame kept since ``first``: points ``(M, 3)`` in its camera, in `unit_name`.

        Of every ``stride``-th pixel. Without ``with_map`` no frame is kept.
        """
        self._observer.flush()
        kept = (each for each in self._observer.measured.keyframes if each.index >= first)
        camera, unit = self._sequence.intrinsics, self._poses.unit
        return {each.index: unit * each.cloud_unscaled(camera, stride) for each in kept}

    def _solved(self) -> Estimate:
        """Of the whole drive so far."""
        if self._estimate is None or len(self._estimate.optimised) != len(self):
            self.close_loops()
        if self._estimate is None:
            raise SlamError("there are too few usable frames to solve the drive")
        return self._estimate


def _window(measured: Measured, first: int) -> Measured:
    """What was measured from frame ``first`` on, which becomes frame 0; without views and keyframes.

    It takes as long as there are frames since, however long the drive.
    """

    def within(items: dict[Any, T]) -> dict[Any, T]:
        """What begins in the window, by its new frames, of items in order of time that span a few."""
        kept = list(takewhile(lambda frames: frames[0] >= first, reversed(items)))
        return {tuple(k - first for k in frames): items[frames] for frames in reversed(kept)}

    window = Measured(
        road_steps=within(measured.road_steps),
        relative_rotations=within(measured.relative_rotations),
        failures=within(measured.failures),
        roads=measured.roads[first:],
        unusable={k - first: why for k, why in measured.unusable.items() if k >= first},
        repeated=[k - first for k in measured.repeated if k >= first],
        below_is_nearer=measured.below_is_nearer,
    )
    for sources, snippet in within(measured.snippets).items():
        target = snippet.target - first
        window.snippets[sources] = replace(snippet, target=target, sources=sources)
    for ends, motion in within(measured.steps).items():
        pose = replace(motion.relative_pose, from_index=ends[0], to_index=ends[1])
        window.steps[ends] = replace(motion, relative_pose=pose)
    return window


def _require_possible(intrinsics: Intrinsics, camera_height_m: float | None) -> None:
    """Refuse a camera that cannot be."""
    if (problem := impossible(intrinsics)) is not None:
        raise SlamError(f"intrinsics: {problem}")
    if camera_height_m is not None and not 0 < camera_height_m <= HIGHEST_M:
        raise SlamError(
            f"camera_height_m must be metres above the road, to {HIGHEST_M:g}; got {camera_height_m!r}"
        )
