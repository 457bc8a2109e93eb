"""The metrics of a run and its row in the CSV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from benchmarking.plan import slug
from benchmarking.work import JobResult

from slam.results.comparison import lookup


@dataclass(frozen=True)
class MetricDefinition:
    """A metric of a run: its column in the CSV, its title in a table, its path in ``metrics.json``, its decimals."""

    key: str
    title: str
    path: tuple[str, ...]
    decimals: int


def _error(trajectory: str, alignment: str) -> MetricDefinition:
    path = ("trajectories", trajectory, "align", f"{alignment}dof", "ate_rmse_m")
    return MetricDefinition(f"ate_{alignment}dof_{trajectory}_m", f"ATE {alignment}-dof, {trajectory}", path, 2)


STAGES = ("timing", "stages")
_ALIGNED = ("trajectories", "optimised", "align", "7dof")
FRAMES = MetricDefinition("frames", "frames", ("sequence", "frames"), 0)
LENGTH = MetricDefinition("length_m", "path (m)", ("sequence", "length_m"), 0)
ERRORS = tuple(_error(trajectory, dof) for dof in "76" for trajectory in ("network", "odometry", "optimised"))
ATE_7, ATE_6 = ERRORS[2], ERRORS[5]
R_REL = MetricDefinition("r_rel_deg_per_100m", "r_rel (deg / 100 m)", (*_ALIGNED, "r_rel_deg_per_100m"), 2)
SCALE = MetricDefinition("scale", "scale", (*_ALIGNED, "scale"), 3)
PERCENT = MetricDefinition("ate_7dof_optimised_percent", "% of path", ("derived", "optimised_percent"), 2)
NETWORK_PERCENT = MetricDefinition("ate_7dof_network_percent", "network, % of path", ("derived", "network_percent"), 2)
OF_NETWORK = MetricDefinition("ate_7dof_of_network", "of network's", ("derived", "of_network"), 2)
LOOPS = MetricDefinition("loops_accepted", "loops closed", ("loops", "accepted"), 0)
TRUE_LOOPS = MetricDefinition("loops_true", "true loops", ("derived", "true_loops"), 0)
FALSE_LOOPS = MetricDefinition("loops_false", "false loops", ("derived", "false_loops"), 0)
COVERAGE = MetricDefinition("coverage_95", "coverage of 95 %", ("graph", "coverage", "95"), 2)
TRIANGLES = MetricDefinition("map_triangles", "map triangles", ("map", "triangles"), 0)
MAP_ERRORS = (
    MetricDefinition("map_accuracy_median_m", "accuracy, median (m)", ("map", "accuracy_median_m"), 3),
    MetricDefinition("map_accuracy_90_m", "90 % (m)", ("map", "accuracy_90_m"), 2),
    MetricDefinition("map_in_field_90_m", "90 % where the scanner looked (m)", ("map", "in_field", "accuracy_90_m"), 2),
    MetricDefinition("map_completeness", "completeness, 0.3 m", ("map", "completeness"), 2),
    MetricDefinition("map_f_score_02", "F-score, 0.2 m", ("map", "f_score", "0.2"), 2),
    MetricDefinition("map_f_score_05", "0.5 m", ("map", "f_score", "0.5"), 2),
    MetricDefinition("map_double_wall_share", "double walls", ("map", "double_wall_share"), 4),
)
MAP_SIZES = (
    TRIANGLES,
    MetricDefinition("map_blocks", "blocks", ("map", "blocks"), 0),
    MetricDefinition("map_submaps", "submaps", ("map", "submaps"), 0),
    MetricDefinition("map_frames_fused", "frames fused", ("map", "frames_fused"), 0),
    MetricDefinition("map_floater_share", "floaters", ("map", "floater_share"), 3),
)
FUSION = MetricDefinition("fusion_ms_per_keyframe", "fusion (ms / keyframe)", ("derived", "fusion_ms"), 1)
MESH = MetricDefinition("mesh_seconds", "mesh (s)", (*STAGES, "mesh"), 1)
RATE = MetricDefinition("frames_per_second", "frames / s", ("timing", "frames_per_second"), 1)
MEMORY = MetricDefinition("peak_rss_mb", "peak RSS (MiB)", ("timing", "peak_rss_mb"), 0)
SECONDS = MetricDefinition("seconds_total", "seconds", ("timing", "seconds_total"), 1)
COMMAND = MetricDefinition("command_seconds", "whole command (s)", ("process", "seconds"), 1)
LOAD = MetricDefinition("load_average", "load before", ("process", "load"), 1)
TIME = MetricDefinition("ms_per_frame", "ms / frame", ("process", "ms_per_frame"), 1)
CPU = MetricDefinition("cpu_ms_per_frame", "CPU ms / frame", ("process", "cpu_ms_per_frame"), 1)
DEFINITIONS = (FRAMES, LENGTH, *ERRORS, PERCENT, NETWORK_PERCENT, OF_NETWORK, R_REL, SCALE)
DEFINITIONS += (LOOPS, TRUE_LOOPS, FALSE_LOOPS, COVERAGE, TRIANGLES)
DEFINITIONS += (*MAP_ERRORS, *MAP_SIZES[1:], FUSION, MESH)
DEFINITIONS += (RATE, MEMORY, SECONDS, TIME, CPU, COMMAND, LOAD)


def rows(results: Sequence[JobResult]) -> list[dict[str, Any]]:
    """One row a run for the CSV: what ran, what came out, seconds by stage."""
    return [
        {
            "sequence": o.job.drive.name,
            "weights": o.job.weights,
            "configuration": o.job.configuration.name,
            "seed": o.job.seed,
            "commit": o.commit,
            "status": "failed" if o.reason else "ok",
            "reason": o.reason,
            "leak": lookup(o.metrics, "provenance", "leak")[0],
            **{q.key: lookup(o.metrics, *q.path)[0] for q in DEFINITIONS},
            **{f"seconds_{slug(stage)}": lookup(o.metrics, *STAGES, stage)[0] for stage in stages(results)},
        }
        for o in results
    ]


def stages(results: Sequence[JobResult]) -> list[str]:
    """Every stage that some run went through, in order of appearance."""
    return list(dict.fromkeys(stage for o in results for stage in lookup(o.metrics, *STAGES)[0] or ()))
