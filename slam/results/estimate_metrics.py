"""The metrics of an estimate and of the whole run.

Errors of its map and depth are by the truth that its sequence has: a surface, depth maps or LiDAR scans.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri, fdtri

from erfsfm.evaluation.pose_metrics import (
    SnippetErrors,
    snippet_errors,
    snippet_from_network,
    snippets_from_trajectory,
)
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
from slam.evaluation.trajectory import TrajectoryMetrics, trajectory_metrics
from slam.formats.trajectory import Trajectory
from slam.frames import DepthMap, Intrinsics, Mask, RelativePose, runs
from slam.frames import Sequence as FrameSequence
from slam.frontend.drive import DOUBLED
from slam.frontend.gps import GpsFixes, Location
from slam.frontend.lidar_odometry import LidarPath, readable_scan
from slam.geometry.se3 import FloatArray, Similarity, apply, invert, umeyama
from slam.graph.pose_graph import whitened_squared
from slam.loops.closure import MOST_REJECTED, LoopClosures
from slam.mapping.depth import KeyframeDepth
from slam.pipeline.estimate import Estimate
from slam.results import metrics as records
from slam.results.metrics import DepthOfKeyframes, Metrics
from slam.runtime.errors import Failed, SlamError
from slam.runtime.resources import Stopwatch, peak_rss_mb
from slam.sequences.catalogue import SimulatedSequence
from slam.sequences.recording import RecordedSequence

logger = logging.getLogger(__name__)

LEVELS = (50, 90, 95)  # per cent of the factors that the bounds of their stated noise hold
_NO_TRUTH = Failed("the sequence has no true poses")
_BY_MAPS = Failed("maps of keyframes give the poses, not steps from frame to frame")
_NO_MAP_YET = Failed("the run ended before its map was whole")
_MAP_ERRORS = (*ERRORS, "truth", "evaluated_m", "with_scale")
_NEAREST_M = 0.1  # z-depth of a LiDAR point that can be in the image
_DEPTH_RANGE_M = 50.0
_MOST_PIXELS = 70_000  # of a depth map; larger ones are sampled
_EVERY_RENDERED = 5  # rendering a keyframe's true depth takes as long as refining it


def estimate_metrics(
    result: Estimate,
    sequence: FrameSequence,
    provenance: records.Provenance,
    gps_in_graph: bool = True,
) -> Metrics:
    """All metrics before the map is fused."""
    return Metrics.of(
        schema_=1,
        status="estimated",
        reason="the run has not ended, or was killed while it made the map or the report",
        provenance=provenance,
        sequence=_sequence(result, sequence),
        timing=timing_of(result.stopwatch, len(sequence)),
        scale=_scale(result),
        agreement=[records.AgreementMetrics(**asdict(each)) for each in result.agreements],
        confidence=records.ConfidenceMetrics.of(run=result.confidence),
        support=_BY_MAPS
        if (support := result.drive.support) is None
        else support.round(2).tolist(),
        trajectories=records.Trajectories.of(
            network=trajectory_metrics(result.network, result.reference, _network_snippets(result)),
            odometry=trajectory_metrics(result.odometry, result.reference),
            optimised=trajectory_metrics(result.optimised, result.reference),
            lidar=_lidar_metrics(result),
        ),
        gps=_gps(result, gps_in_graph),
        graph=_graph(result),
        loops=_loops(result.loops),
        tracking=_tracking(result),
        depth_error=_depth_error(result),
        depth=_NO_MAP_YET,
        map=_NO_MAP_YET,
    )


def lidar_trajectory(result: Estimate) -> Trajectory | None:
    """LiDAR odometry with the stamps of its frames."""
    if not isinstance(result.lidar, LidarPath):
        return None
    return Trajectory(result.optimised.stamps[result.lidar.frames], result.lidar.T_world_camera)


def timing_of(watch: Stopwatch, frames: int) -> records.Timing:
    """The time of a run until now."""
    seconds = watch.seconds
    return records.Timing.of(
        seconds_total=seconds,
        frames_per_second=frames / seconds,
        cpu_seconds=watch.cpu_seconds,
        peak_rss_mb=peak_rss_mb(),
        stages=dict(watch.stages),
    )


def _sequence(result: Estimate, sequence: FrameSequence) -> records.SequenceMetrics:
    frames = len(sequence)
    span = float(sequence.stamps[-1] - sequence.stamps[0]) if frames > 1 else 0.0
    drive, reference = result.drive, result.reference
    scans = result.lidar.unreadable if isinstance(result.lidar, LidarPath) else {}
    return records.SequenceMetrics.of(
        name=sequence.name,
        frames=frames,
        length_m=_NO_TRUTH if reference is None else reference.length_m,
        fps=(frames - 1) / span if span > 0 else Failed("all stamps are equal"),
        bridged_frames=len(drive.interpolated),
        bridged=_stretches(drive.interpolated),
        doubled=_stretches(dict.fromkeys(drive.doubled, DOUBLED)),
        unreadable_scans=_stretches(scans),
        segments=[records.Stretch(**asdict(segment)) for segment in drive.segments],
    )


def _stretches(reasons: Mapping[int, str]) -> list[records.Stretch]:
    """Consecutive frames with the reason of the first."""
    return [
        records.Stretch(first=first, last=last, reason=reasons[first])
        for first, last in runs(reasons)
    ]


def _lidar_metrics(result: Estimate) -> TrajectoryMetrics | Failed:
    """Errors of LiDAR odometry at its frames."""
    path = result.lidar
    if not isinstance(path, LidarPath):
        return path or Failed("the sequence has no LiDAR scans")
    reference = None if result.reference is None else result.reference.select(path.frames).rebased()
    return trajectory_metrics(
        Trajectory(result.optimised.stamps[path.frames], path.T_world_camera), reference
    )


def _network_snippets(result: Estimate) -> SnippetErrors | None:
    """The paper's protocol on the network's snippet poses; None without truth or with other snippets."""
    snippets = result.drive.snippets
    if result.reference is None or len(snippets[0].sources) != 4:
        return None
    predicted = np.stack([snippet_from_network(s.T_source_target) for s in snippets])
    return snippet_errors(predicted, snippets_from_trajectory(result.reference.T_world_camera))


def _scale(result: Estimate) -> records.ScaleMetrics:
    scale, estimate = result.scale, result.scale.estimate
    found = {"value": estimate} if isinstance(estimate, Failed) else asdict(estimate)
    return records.ScaleMetrics.of(
        mode=scale.mode, unit=scale.unit, contradicted_steps=len(scale.contradicted), **found
    )


def _graph(result: Estimate) -> records.GraphMetrics:
    """Size of the graph, and coverage of its noise by the truth at the graph's scale."""
    if isinstance(result.graph, Failed):
        return records.GraphMetrics.unknown(result.graph.reason)
    nodes, factors = len(result.optimised), result.graph.relative_poses
    if result.reference is None:
        return records.GraphMetrics.of(nodes=nodes, factors=len(factors), coverage=_NO_TRUTH)
    aligned = umeyama(result.optimised.positions, result.reference.positions, with_scale=True)
    if not aligned.scale > 0:
        still = Failed("the estimate does not move: the truth cannot be scaled to it")
        return records.GraphMetrics.of(nodes=nodes, factors=len(factors), coverage=still)
    covered = coverage(factors, result.reference.T_world_camera, aligned.scale)
    by_source = {source: records.CoverageMetrics.of(**shares) for source, shares in covered.items()}
    overall = by_source.pop("")
    return records.GraphMetrics(
        nodes=nodes, factors=len(factors), coverage=overall, coverage_by_source=by_source
    )


def coverage(
    relative_poses: Sequence[RelativePose], T_world_camera_true: FloatArray, scale: float
) -> dict[str, dict[str, float]]:
    """Ratio of factors whose error lies inside the 50, 90 and 95 % bound of their stated noise, ``{"50": 0.49, ...}``.

    Under ``""`` of all of them, and by source, there with their number under ``factors``.

    Args:
        relative_poses: measurements with their noise, at least one.
        T_world_camera_true: truth ``(N, 4, 4)``, metres.
        scale: units of the measurements per metre, positive; scales the truth to them.
    """
    T_world_camera = T_world_camera_true.copy()
    T_world_camera[:, :3, 3] *= scale
    squared = whitened_squared(relative_poses, T_world_camera)
    dofs, dof_of_factor = np.unique(
        [edge.student_t_dof for edge in relative_poses], return_inverse=True
    )
    inside = {}
    for level in LEVELS:
        bounds = np.array([squared_bound(level / 100, dof) for dof in dofs])
        inside[str(level)] = squared <= bounds[dof_of_factor]  # (F,)
    sources = np.array([edge.source for edge in relative_poses])
    found = {"": {level: float(within.mean()) for level, within in inside.items()}}
    for source in np.unique(sources):
        ratios = {
            level: float(within[sources == source].mean()) for level, within in inside.items()
        }
        found[str(source)] = {"factors": int((sources == source).sum()), **ratios}
    return found


def squared_bound(probability: float, student_t_dof: float) -> float:
    """Quantile of the whitened squared error of six numbers.

    For errors by Student's t with ``student_t_dof`` degrees of freedom, whose standard deviations are the sigmas: a
    quantile of Fisher's F. For normal errors (infinite ``student_t_dof``): a quantile of chi-square.
    """
    if math.isinf(student_t_dof):
        return float(chdtri(6, 1.0 - probability))
    return float(6 * (student_t_dof - 2) / student_t_dof * fdtri(6, student_t_dof, probability))


def _loops(found: LoopClosures) -> records.LoopMetrics:
    """Loops by how far they came, and the reasons of the rejected ones with most inliers."""
    counts = {
        "candidates": found.candidates,
        "verified": found.verified,
        "accepted": len(found.accepted),
    }
    if found.not_sought is not None:
        return records.LoopMetrics.of(
            **dict.fromkeys(counts, Failed(found.not_sought)), rejected=[]
        )
    rejected = found.rejected[:MOST_REJECTED]
    ends = [
        records.LoopEnds.of(from_=each.from_index, to=each.to_index, reason=each.reason)
        for each in rejected
    ]
    return records.LoopMetrics.of(**counts, rejected=ends)


def _tracking(result: Estimate) -> records.TrackingMetrics | Failed:
    """Keyframes, their maps, and what became of them."""
    drive = result.drive
    if not drive.maps:
        return Failed("this drive has no map of keyframes: it is measured from step to step")
    return records.TrackingMetrics(
        keyframes=sum(len(segment.keyframes) for segment in drive.maps),
        maps=len(set(drive.map_poses.component.values())),
        located_frames=len(drive.map_poses.segments),
        events=[records.Event(**asdict(event)) for event in drive.events],
    )


def _depth_error(result: Estimate) -> list[dict[str, float | None]] | Failed:
    """Bias and sigma of learned depth over distance at the end of the drive, in the unit of the trajectory."""
    curve, unit = result.drive.depth_error.curve(), float(np.median(result.scale.per_frame))
    if not curve:
        return Failed("no step triangulated corners with learned depth")
    return [
        {"depth": unit * at, "bias": b, "sigma": s, "corners": count} for at, b, s, count in curve
    ]


def _gps(result: Estimate, in_graph: bool) -> records.GpsMetrics | Failed:
    """Distances of odometry and optimised trajectory from the fixes, and the place of the first camera."""
    location = result.location
    if not isinstance(location, Location):
        return location or Failed("no GPS track was given")
    T_enu_first = location.T_enu_world @ result.optimised.T_world_camera[0]
    latitude, longitude, height = location.fixes.frame.places(T_enu_first[None, :3, 3])[0].tolist()
    ahead = T_enu_first[:3, 2]
    heading = float(np.rad2deg(np.arctan2(ahead[0], ahead[1])) % 360.0)
    aligned = location.fixes.align(result.odometry.T_world_camera)
    return records.GpsMetrics.of(
        fixes=len(location.fixes.stamps),
        in_graph=in_graph,
        origin=records.Origin(
            latitude_deg=latitude, longitude_deg=longitude, altitude_m=height, heading_deg=heading
        ),
        odometry=aligned
        if isinstance(aligned, Failed)
        else _distances(location.fixes, aligned, result.odometry),
        optimised=_distances(location.fixes, location.T_enu_world, result.optimised),
    )


def _distances(
    fixes: GpsFixes, T_enu_world: FloatArray, trajectory: Trajectory
) -> records.GpsErrors:
    apart = fixes.offsets(T_enu_world @ trajectory.T_world_camera)
    level = np.linalg.norm(apart[:, :2], axis=1)
    return records.GpsErrors(
        horizontal_rmse_m=float(np.sqrt((level**2).mean())),
        horizontal_median_m=float(np.median(level)),
        vertical_rmse_m=float(np.sqrt((apart[:, 2] ** 2).mean())),
    )


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

    def in_field(
        points: FloatArray, frames: Indices
    ) -> Mask:  # all, for the map comes from the same images
        return np.ones(len(points), dtype=bool)

    name = "depth maps" if exact is None else "exact surface"
    return SurfaceTruth(
        name, np.array(sequence.true_depth_frames(), np.int64), view, in_field, distance
    )


def lidar_truth(
    sequence: FrameSequence, reference: FloatArray, T_camera_lidar: FloatArray
) -> SurfaceTruth:
    """LiDAR scans at true poses ``(N, 4, 4)``, points within 25 m of the scanner; moving objects are among them.

    A scan that cannot be read, of which LiDAR odometry has warned, has no point. Completeness is about points in the
    images; the accuracy of the map is measured against all. In the field are points within 25 m of a scanner, between
    its lowest and its highest beam.
    """
    limits: dict[int, tuple[float, float]] = {}  # sines of the lowest and the highest beam

    def view(frame: int) -> Surface:
        points = readable_scan(sequence, frame)
        if isinstance(points, str):
            points = np.empty((0, 3))
        ranges = np.linalg.norm(points, axis=1)
        sines = points[ranges > 1.0, 2] / ranges[ranges > 1.0]
        beams = (
            np.quantile(sines, [0.001, 0.999]) if len(sines) else (1.0, -1.0)
        )  # stray points left out
        limits[frame] = float(beams[0]), float(beams[1])
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
    looked_at = np.concatenate(
        [*stretches(sequence.reference, truth.frames), np.empty(0, np.int64)]
    ).astype(np.int64)
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
        moved = fit.scale * points @ fit.R_a_b.T + fit.t_a_b
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
        unreadable = f"the true depth of {len(self._unreadable)} keyframes cannot be read"
        if self._unreadable:
            logger.warning("%s, first %s: they are not compared", unreadable, self._unreadable[0])
        if self._keyframes == 0:
            missing = "there are no keyframes (mapping.enabled)"
        elif not self._is_metric:
            missing = "depth is not in metres (see scale)"
        elif self._unreadable:
            missing = unreadable
        else:
            missing = "the sequence has no true depth (simulated, depth_2 or LiDAR)"
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
    if isinstance(sequence, SimulatedSequence) and count % _EVERY_RENDERED != 1:
        return None
    if isinstance(sequence, RecordedSequence) and index in sequence.true_depth_frames():
        return np.asarray(sequence.true_depth(index), np.float32)
    if sequence.T_camera_lidar is None or not sequence.has_scan(index):
        return None
    return projected(sequence.scan(index), sequence.T_camera_lidar, sequence.intrinsics)


def projected(
    points_lidar: FloatArray, T_camera_lidar: FloatArray, intrinsics: Intrinsics
) -> DepthMap:
    """z-depth ``(H, W)`` of LiDAR points ``(P, 3)`` in the image, the nearest at each pixel, 0 where there is none."""
    points = apply(T_camera_lidar, np.asarray(points_lidar, np.float64))
    points = points[_in_image(points, intrinsics)]
    u, v = np.rint(intrinsics.project(points)).astype(int).T
    depth = np.full((intrinsics.height, intrinsics.width), np.inf, np.float32)
    np.minimum.at(depth, (v, u), points[:, 2].astype(np.float32))
    return np.where(np.isfinite(depth), depth, np.float32(0))
