"""The metrics of an estimate, before its map is fused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.special import fdtri

from erfsfm.common.readers.frame_range import runs
from erfsfm.evaluation.pose_metrics import (
    SnippetErrors,
    snippet_errors,
    snippet_from_network,
    snippets_from_trajectory,
)
from slam.evaluation.trajectory import TrajectoryMetrics, trajectory_metrics
from slam.formats.trajectory import Trajectory
from slam.frames import RelativePose
from slam.frames import Sequence as FrameSequence
from slam.frontend.agreement import SHAPE_WITHIN
from slam.frontend.drive import DOUBLED
from slam.frontend.gps import GpsFixes, Location
from slam.frontend.lidar_odometry import LidarPath
from slam.frontend.visual.odometry import STILL_SOURCE
from slam.geometry.robust import median, rms
from slam.geometry.se3 import FloatArray, path_distance, umeyama
from slam.graph.pose_graph import whitened_squared
from slam.loops.closure import MOST_REJECTED, LoopClosures
from slam.pipeline.estimate import Estimate
from slam.results import metrics as records
from slam.results.metrics import Metrics
from slam.runtime.errors import Failed
from slam.runtime.memory import peak_rss_mb
from slam.runtime.stopwatch import Stopwatch

LEVELS = (50, 90, 95)  # per cent of the factors that the bounds of their stated noise hold
_NO_TRUTH = Failed("the sequence has no true poses")
_NORMAL_DOF = 1e12  # whose F is a chi-square over its degrees of freedom, to 1e-11
_TOP_SPEED_S = 1.0  # steps alone are noisy
_NO_HEIGHTS = Failed("the GPS track has no altitudes")
_BY_MAPS = Failed("maps of keyframes give the poses, not steps from frame to frame")
_NOTHING_FIXED = Failed(
    "nothing was found that is fixed to the camera, or too few images moved to find it"
)
_STANDS_STILL = Failed("the estimate does not move: the truth cannot be scaled to it")
_NO_MAP_YET = Failed("the run ended before its map was whole")


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
        motion=_motion(result),
        timing=timing_of(result.stopwatch, len(sequence)),
        scale=_scale(result),
        agreement=[*result.agreements],
        confidence=records.ConfidenceMetrics.of(
            run=result.confidence,
            shape=result.shape,
            shape_within=SHAPE_WITHIN[result.drive.by_keyframes],
        ),
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
    span = float(sequence.stamps[-1] - sequence.stamps[0])
    drive, reference = result.drive, result.reference
    scans = result.lidar.unreadable if isinstance(result.lidar, LidarPath) else {}
    return records.SequenceMetrics.of(
        name=sequence.name,
        frames=frames,
        length_m=_NO_TRUTH if reference is None else reference.length_m,
        fps=(frames - 1) / span,
        bridged_frames=len(drive.interpolated),
        bridged=_stretches(drive.interpolated),
        doubled=_stretches(dict.fromkeys(drive.doubled, DOUBLED)),
        unreadable_scans=_stretches(scans),
        segments=[*drive.segments],
        fixed_share=_NOTHING_FIXED
        if drive.measured.fixed is None
        else float(drive.measured.fixed.mean()),
    )


def _motion(result: Estimate) -> records.MotionMetrics:
    """How far and how fast the camera moved, and how often its steps were measured as standing."""
    path, seconds = path_distance(result.optimised.T_world_camera), result.optimised.stamps
    span = float(seconds[-1] - seconds[0])
    window = min(_TOP_SPEED_S, span)
    begins = seconds[seconds <= seconds[-1] - window]
    ahead = np.interp(begins + window, seconds, path) - path[: len(begins)]
    drive = result.drive
    standing = sum(
        each.relative_pose.source == STILL_SOURCE and to - start == 1
        for (start, to), each in drive.steps.items()
    )
    return records.MotionMetrics.of(
        path=float(path[-1]),
        mean_speed=float(path[-1] / span),
        top_speed=float(ahead.max() / window),
        standing_share=standing / (len(path) - 1) if drive.support is not None else _BY_MAPS,
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
    factors = result.graph.relative_poses
    held: dict[str, Any] = {"coverage": _NO_TRUTH}
    if result.reference is not None:
        aligned = umeyama(result.optimised.positions, result.reference.positions, with_scale=True)
        held = {"coverage": _STANDS_STILL}
        if aligned.scale > 0:
            by_source = coverage(factors, result.reference.T_world_camera, aligned.scale)
            held = {"coverage": by_source.pop(""), "coverage_by_source": by_source}
    return records.GraphMetrics.of(nodes=len(result.optimised), factors=len(factors), **held)


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
        own = sources == source
        ratios = {level: float(within[own].mean()) for level, within in inside.items()}
        found[str(source)] = {"factors": int(own.sum()), **ratios}
    return found


def squared_bound(probability: float, student_t_dof: float) -> float:
    """Quantile of the whitened squared error of six numbers.

    For errors by Student's t with ``student_t_dof`` degrees of freedom, whose standard deviations are the sigmas: a
    quantile of Fisher's F. For normal errors (infinite ``student_t_dof``) that is one of chi-square.
    """
    dof = min(student_t_dof, _NORMAL_DOF)
    return float(6 * (dof - 2) / dof * fdtri(6, dof, probability))


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
        records.LoopEnds.of(from_=each.ends[0], to=each.ends[1], reason=each.reason)
        for each in rejected
    ]
    return records.LoopMetrics.of(**counts, rejected=ends)


def _tracking(result: Estimate) -> records.TrackingMetrics | Failed:
    """Keyframes, their maps, and what became of them."""
    drive = result.drive
    if not drive.by_keyframes:
        return Failed("this drive has no map of keyframes: it is measured from step to step")
    return records.TrackingMetrics.of(
        keyframes=sum(len(segment.keyframes) for segment in drive.measured.maps),
        maps=len(set(drive.map_poses.component.values())),
        located_frames=len(drive.map_poses.segments),
        events=[*drive.events],
    )


def _depth_error(result: Estimate) -> list[dict[str, float | None]] | Failed:
    """Bias and sigma of learned depth over distance at the end of the drive, in the unit of the trajectory."""
    curve = result.drive.measured.depth_error.curve()
    unit = median(result.scale.per_frame)
    if not curve:
        return Failed("no step triangulated corners with learned depth")
    return [
        {"depth": unit * depth, "bias": bias, "sigma": sigma, "corners": corners}
        for depth, bias, sigma, corners in curve
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
        origin=records.Origin.of(
            latitude_deg=latitude,
            longitude_deg=longitude,
            altitude_m=height if location.fixes.has_heights else _NO_HEIGHTS,
            heading_deg=heading,
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
    return records.GpsErrors.of(
        horizontal_rmse_m=rms(level),
        horizontal_median_m=median(level),
        vertical_rmse_m=rms(apart[:, 2]) if fixes.has_heights else _NO_HEIGHTS,
    )
