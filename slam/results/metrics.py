"""The content of ``metrics.json`` (``docs/outputs.md``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from erfsfm.evaluation.pose_metrics import (
    SnippetErrors,
    snippet_errors,
    snippet_from_network,
    snippets_from_trajectory,
)
from slam.evaluation.coverage import coverage
from slam.evaluation.trajectory import trajectory_metrics
from slam.formats.trajectory import Trajectory, associate
from slam.frames import Sequence
from slam.frontend.drive import DOUBLED
from slam.frontend.failure import MeasurementFailure
from slam.frontend.lidar_odometry import LidarPath
from slam.geometry.se3 import umeyama
from slam.pipeline.estimate import Estimate
from slam.results.folder import TRAJECTORIES, RunFolder
from slam.results.gps import gps_metrics
from slam.results.summary import (
    SCHEMA,
    Provenance,
    describe_frames,
    describe_gaps,
    describe_sequence,
    describe_timing,
    finite,
    null,
)
from slam.sequences.continued import unused_scans


def lidar_trajectory(result: Estimate) -> Trajectory | None:
    """LiDAR odometry with the stamps of its frames."""
    if not isinstance(result.lidar, LidarPath):
        return None
    return Trajectory(result.optimised.stamps[result.lidar.frames], result.lidar.T_world_camera)


def _lidar_metrics(result: Estimate, sequence: Sequence) -> dict[str, Any]:
    """Errors of LiDAR odometry at its frames."""
    path, lidar = result.lidar, lidar_trajectory(result)
    if isinstance(path, MeasurementFailure):
        return null("lidar", path.reason)
    if path is None or lidar is None:
        return null("lidar", unused_scans(sequence) or "the sequence has no LiDAR scans")
    reference = None if result.reference is None else result.reference.select(path.frames).rebased()
    return {"lidar": trajectory_metrics(lidar, reference)}


def estimate_metrics(
    result: Estimate, sequence: Sequence, provenance: Provenance, gps_in_graph: bool = True
) -> dict[str, Any]:
    """All metrics before the map is fused; a missing number is null with its reason."""
    reference = result.reference
    trajectories = {
        "network": trajectory_metrics(result.network, reference, _network_snippets(result)),
        "odometry": trajectory_metrics(result.odometry, reference),
        "optimised": trajectory_metrics(result.optimised, reference),
        **_lidar_metrics(result, sequence),
    }
    doubled = dict.fromkeys(result.drive.doubled, DOUBLED)
    metrics: dict[str, Any] = finite(
        {
            "schema": SCHEMA,
            "status": "estimated",
            "reason": "the run has not ended, or was killed while it made the map",
            "provenance": provenance.described(),
            "sequence": describe_sequence(sequence, reference.length_m if reference is not None else None)
            | describe_gaps(result.drive.interpolated)
            | {"doubled": describe_frames(doubled)}
            | {"unreadable_scans": describe_frames(_unreadable_scans(result))}
            | {"continued_at": result.first}
            | {"segments": [asdict(segment) for segment in result.drive.segments]},
            "timing": describe_timing(result.stopwatch, len(sequence) - result.first),
            "scale": _scale(result),
            "trajectories": trajectories,
            **gps_metrics(result, gps_in_graph),
            "graph": _graph(result),
            "loops": result.loops.summary(),
            **_tracking(result),
            **_depth_error(result),
            **null("depth", "the run ended before its map was whole"),
            **null("map", "the run ended before its map was whole"),
        }
    )
    return metrics


def _unreadable_scans(result: Estimate) -> Mapping[int, str]:
    """Frames whose LiDAR scan was left out of the odometry, with the reason."""
    return result.lidar.unreadable if isinstance(result.lidar, LidarPath) else {}


def _tracking(result: Estimate) -> dict[str, Any]:
    """Keyframes, their maps, and what became of them."""
    drive = result.drive
    if not drive.maps:
        return null("tracking", "this drive has no map of keyframes: it is measured from step to step")
    return {
        "tracking": {
            "keyframes": sum(len(segment.map.keyframes) for segment in drive.maps),
            "maps": len(set(drive.map_poses.segments.values())),
            "events": [asdict(event) for event in drive.events],
        }
    }


def _depth_error(result: Estimate) -> dict[str, Any]:
    """Bias and sigma of learned depth over distance at the end of the drive, in the unit of the trajectory."""
    curve, unit = result.state.odometry.depth_error.curve(), float(np.median(result.scale.per_frame))
    if not curve:
        return null("depth_error", "no step triangulated corners with learned depth")
    keys = ("depth", "bias", "sigma", "corners")
    return {"depth_error": [dict(zip(keys, (unit * depth, *rest), strict=True)) for depth, *rest in curve]}


def whole_metrics(
    metrics: dict[str, Any], result: Estimate, sequence: Sequence, map_summary: dict[str, Any], depth: dict[str, Any]
) -> dict[str, Any]:
    """The metrics of a complete run: those of the estimate, with depth, the map and the final timing."""
    timing = describe_timing(result.stopwatch, len(sequence) - result.first)
    rest = {"timing": timing, "depth": depth, "map": map_summary}
    whole: dict[str, Any] = metrics | {"status": "ok"} | finite(rest)
    return {key: value for key, value in whole.items() if key not in ("reason", "depth_reason", "map_reason")}


def trajectory_metrics_of(folder: RunFolder) -> dict[str, Any]:
    """Errors of the trajectories in the folder of a killed run; a reason for each missing one."""
    reference = folder.trajectory("reference")
    numbers: dict[str, Any] = {}
    for name in TRAJECTORIES:
        estimate = folder.trajectory(name)
        if estimate is None:
            numbers |= null(name, "the run did not write this trajectory")
        elif reference is None:
            numbers[name] = trajectory_metrics(estimate, None)
        else:
            numbers[name] = trajectory_metrics(*associate(estimate, reference))
    return numbers


def _network_snippets(result: Estimate) -> SnippetErrors | None:
    """The paper's protocol on the network's snippet poses; None without truth or with other snippets."""
    snippets = result.drive.snippets
    if result.reference is None or len(snippets[0].sources) != 4:
        return None
    predicted = np.stack([snippet_from_network(s.T_source_target) for s in snippets])
    return snippet_errors(predicted, snippets_from_trajectory(result.reference.T_world_camera))


def _scale(result: Estimate) -> dict[str, Any]:
    scale, estimate = result.scale, result.scale.estimate
    named = {"mode": scale.mode, "unit": scale.unit}
    if isinstance(estimate, MeasurementFailure):
        return named | null("value", estimate.reason)
    return named | {"value": estimate.value, "spread": estimate.spread, "frames_used": estimate.frames_used}


def _graph(result: Estimate) -> dict[str, Any]:
    """Size of the graph, and coverage of its noise by the truth at the graph's scale."""
    summary: dict[str, Any] = {"nodes": len(result.optimised), "factors": len(result.graph.relative_poses)}
    if result.reference is None:
        return summary | null("coverage", "the sequence has no true poses")
    aligned = umeyama(result.optimised.positions, result.reference.positions, with_scale=True)
    if not aligned.scale > 0:
        return summary | null("coverage", "the estimate does not move: the truth cannot be scaled to it")
    covered = coverage(result.graph.relative_poses, result.reference.T_world_camera, aligned.scale)
    return summary | {"coverage": covered.overall, "coverage_by_source": covered.by_source}
