"""Errors of the map and of depth by the truth that a sequence has: a surface, depth maps or LiDAR scans."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from slam.evaluation.depth import DepthErrors
from slam.evaluation.map import (
    ERRORS,
    OUTLIER_M,
    RANGE_M,
    Indices,
    PlacedMetrics,
    Surface,
    SurfaceTruth,
    backprojected,
    compare,
    placed_errors,
    pose_similarity,
    stretches,
)
from slam.frames import DepthMap, Intrinsics, Mask
from slam.frames import Sequence as FrameSequence
from slam.frontend.lidar_odometry import readable_scan
from slam.geometry.se3 import FloatArray, Similarity, apply, invert
from slam.mapping.depth import KeyframeDepth
from slam.pipeline.estimate import Estimate
from slam.results.metrics import DepthOfKeyframes
from slam.runtime.errors import Failed, SlamError
from slam.sequences.recording import RecordedSequence

logger = logging.getLogger(__name__)

_MAP_ERRORS = (*ERRORS, "truth", "evaluated_m", "with_scale")
_NEAREST_M = 0.1  # z-depth of a LiDAR point that can be in the image
_DEPTH_RANGE_M = 50.0
_MOST_PIXELS = 70_000  # of a depth map; larger ones are sampled
_EVERY_RENDERED = 5  # rendering a keyframe's true depth takes as long as refining it


def depth_truth(sequence: RecordedSequence, reference: FloatArray) -> SurfaceTruth:
    """Depth maps at true poses ``(N, 4, 4)``; ``distance`` is exact where the surface itself is known.

    A view is the surface within 50 m, for walls may be too high for the images from nearby; completeness is about 25 m.
    """
    exact, T_any_camera = sequence.distance_to_surface, sequence.T_any_camera
    distance: Callable[[FloatArray], FloatArray] | None = None
    if exact is not None and T_any_camera is not None:
        distance = lambda points: exact(apply(T_any_camera[0], points))  # noqa: E731

    def view(frame: int) -> Surface:
        T_world_camera, depth = reference[frame], sequence.true_depth(frame)
        height, width = depth.shape
        camera = Intrinsics.of(sequence.intrinsics.resized(width, height))
        step = int(np.ceil(np.sqrt(height * width / _MOST_PIXELS)))
        offset = frame % step  # other pixels in neighbouring frames
        rays = camera.rays(camera.pixel_grid()[offset::step, offset::step])
        points = backprojected(
            depth[offset::step, offset::step], rays, T_world_camera, _DEPTH_RANGE_M
        )
        return Surface(points, np.linalg.norm(points - T_world_camera[:3, 3], axis=1) <= RANGE_M)

    name = "depth maps" if exact is None else "exact surface"
    frames = np.array(sequence.true_depth_frames(), np.int64)
    # all points are in the field, for the map comes from the same images
    return SurfaceTruth(name, frames, view, distance=distance)


def lidar_truth(
    sequence: FrameSequence, reference: FloatArray, T_camera_lidar: FloatArray
) -> SurfaceTruth:
    """LiDAR scans at true poses ``(N, 4, 4)``, points within 25 m of the scanner; moving objects are among them.

    A scan that cannot be read, of which LiDAR odometry has warned, has no point. Completeness is about points in the
    images; the accuracy of the map is measured against all. In the field are points within 25 m of a scanner, between
    its lowest and its highest beam.
    """
    limits: dict[int, FloatArray] = {}  # sines of the lowest and the highest beam

    def view(frame: int) -> Surface:
        points = readable_scan(sequence, frame)
        if isinstance(points, str):
            points = np.empty((0, 3))
        ranges = np.linalg.norm(points, axis=1)
        sines = points[ranges > 1.0, 2] / ranges[ranges > 1.0]
        # stray points left out
        known = len(sines) > 0
        limits[frame] = np.quantile(sines, [0.001, 0.999]) if known else np.array([1.0, -1.0])
        points = apply(T_camera_lidar, points[ranges <= RANGE_M])
        return Surface(apply(reference[frame], points), _in_image(points, sequence.intrinsics))

    def in_field(points: FloatArray, frames: Indices) -> Mask:
        found = np.zeros(len(points), dtype=bool)
        for frame in frames.tolist():
            low, high = limits[frame]
            seen = apply(invert(reference[frame] @ T_camera_lidar), points)
            ranges = np.linalg.norm(seen, axis=1)
            sine = seen[:, 2] / np.maximum(ranges, 1e-6)
            found |= (ranges <= RANGE_M) & (sine >= low) & (sine <= high)
        return found

    frames = np.array([k for k in range(len(sequence)) if sequence.has_scan(k)], np.int64)
    return SurfaceTruth("lidar", frames, view, in_field)


def _in_image(points: FloatArray, camera: Intrinsics) -> Mask:
    """Which points of a camera ``(P, 3)`` project into its image."""
    inside: Mask = points[:, 2] > _NEAREST_M
    pixels = camera.project(points[inside])
    inside[inside] = (
        (pixels > -0.5) & (pixels < np.array([camera.width, camera.height]) - 0.5)
    ).all(axis=1)
    return inside


def find_truth(sequence: FrameSequence) -> SurfaceTruth | str:
    """The best truth of a sequence, or why there is none."""
    reference, T_camera_lidar = sequence.reference, sequence.T_camera_lidar
    if reference is None:
        return "the sequence has no true poses"
    if isinstance(sequence, RecordedSequence) and sequence.true_depth_frames():
        return depth_truth(sequence, reference)
    if (
        T_camera_lidar is not None
        and (lidar := lidar_truth(sequence, reference, T_camera_lidar)).frames.size
    ):
        return lidar
    return "the true surface is not known: there are neither depth maps nor LiDAR scans beside the images"


def map_errors(
    pieces: Callable[[], Iterator[FloatArray]], result: Estimate, sequence: FrameSequence
) -> dict[str, Any]:
    """Values of `MapMetrics`: errors of a map moved to the truth rigidly, and under ``with_scale`` by a similarity.

    ``pieces`` iterates over the points of the map, ``(P, 3)`` each; of a long drive only those near the stretches that
    are looked at are held.
    """
    truth = find_truth(sequence)
    if isinstance(truth, str):
        return dict.fromkeys(_MAP_ERRORS, Failed(truth))
    assert sequence.reference is not None
    poses = result.optimised.T_world_camera
    fits = {"with_scale": pose_similarity(sequence.reference, poses)}
    if result.scale.is_metric:
        fits["rigid"] = pose_similarity(sequence.reference, poses, with_scale=False)
    parts = stretches(sequence.reference, truth.frames)
    looked_at = np.concatenate([*parts, np.empty(0, np.int64)])
    cameras = cKDTree(sequence.reference[looked_at, :3, 3])
    placed = {name: _placed(pieces(), fit, cameras) for name, fit in fits.items()}
    try:
        distances, length_m = compare(truth, sequence.reference, placed)
    except SlamError as error:
        logger.warning("the error of the map is not known: %s", error)
        return dict.fromkeys(_MAP_ERRORS, Failed(str(error)))
    if truth.distance is None and len(distances["with_scale"].to_map) == 0:
        return dict.fromkeys(
            _MAP_ERRORS, Failed("no point of the true surface is known near the images")
        )
    no_metres = dict.fromkeys(ERRORS, Failed("lengths are not in metres: see with_scale"))
    errors = placed_errors(distances["rigid"]) if "rigid" in fits else no_metres
    with_scale = PlacedMetrics.of(
        **placed_errors(distances["with_scale"]), scale=fits["with_scale"].scale
    )
    return {**errors, "truth": truth.name, "evaluated_m": length_m, "with_scale": with_scale}


def _placed(pieces: Iterator[FloatArray], fit: Similarity, cameras: cKDTree) -> FloatArray:
    """The points of all pieces in the world of the truth that count at any of these cameras."""
    near = [np.empty((0, 3))]
    for points in pieces:
        moved = fit.apply(points)
        near.append(
            moved[np.isfinite(cameras.query(moved, distance_upper_bound=RANGE_M + OUTLIER_M)[0])]
        )
    return np.concatenate(near)


class DepthQuality:
    """Collects the errors of keyframes while the map is fused."""

    def __init__(self, sequence: FrameSequence, is_metric: bool) -> None:
        """``is_metric`` tells whether the run's depth is in metres."""
        self._sequence, self._is_metric = sequence, is_metric
        self._network, self._refined = DepthErrors(), DepthErrors()
        self._keyframes = 0
        self._unreadable: list[str] = []

    def add(self, keyframe: KeyframeDepth) -> None:
        """Compare a keyframe with the truth, where it is known and can be read."""
        self._keyframes += 1
        if not self._is_metric:
            return
        try:
            truth = true_depth(self._sequence, keyframe.frame, self._keyframes)
        except SlamError as error:
            self._unreadable.append(str(error))
            return
        if truth is None:
            return
        self._network.add(
            keyframe.depth if keyframe.network_depth is None else keyframe.network_depth, truth
        )
        if keyframe.relative_sigma is not None:
            self._refined.add(keyframe.depth, truth, keyframe.relative_sigma)

    def metrics(self, is_refined: bool) -> DepthOfKeyframes:
        """The errors, each missing with a reason where it cannot be computed; warns of unread maps."""
        network, refined = self._network.metrics(), self._refined.metrics()
        missing = "the sequence has no true depth (simulated, depth_2 or LiDAR)"
        if self._keyframes == 0:
            missing = "there are no keyframes (mapping.enabled)"
        elif not self._is_metric:
            missing = "depth is not in metres (see scale)"
        elif self._unreadable:
            missing = f"the true depth of {len(self._unreadable)} keyframes cannot be read"
            logger.warning("%s, first %s: they are not compared", missing, self._unreadable[0])
        if network is None:
            return DepthOfKeyframes.unknown(missing)
        unrefined = (
            "no keyframe has a neighbour at a useful distance"
            if is_refined
            else "depth.refine is none"
        )
        return DepthOfKeyframes.of(network=network, refined=refined or Failed(unrefined))


def true_depth(sequence: FrameSequence, index: int, count: int = 1) -> DepthMap | None:
    """The true z-depth ``(H, W)`` of a frame, 0 where unknown; None without any.

    Of a simulated street only every fifth ``count`` is rendered.
    """
    if isinstance(sequence, RecordedSequence) and index in sequence.true_depth_frames():
        if sequence.is_rendered and count % _EVERY_RENDERED != 1:
            return None
        return sequence.true_depth(index).astype(np.float32)
    if sequence.T_camera_lidar is None or not sequence.has_scan(index):
        return None
    return projected(sequence.scan(index), sequence.T_camera_lidar, sequence.intrinsics)


def projected(
    points_lidar: FloatArray, T_camera_lidar: FloatArray, intrinsics: Intrinsics
) -> DepthMap:
    """z-depth ``(H, W)`` of LiDAR points ``(P, 3)`` in the image, the nearest at each pixel, 0 where there is none."""
    points = apply(T_camera_lidar, points_lidar)
    points = points[_in_image(points, intrinsics)]
    points = points[np.argsort(-points[:, 2])]  # of several at one pixel the last one stays
    u, v = np.rint(intrinsics.project(points)).astype(int).T
    depth = np.zeros((intrinsics.height, intrinsics.width), np.float32)
    depth[v, u] = points[:, 2]
    return depth
