"""The metrics of a run, and its row in the CSV."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarking.definitions import MetricDefinition, share, stage_seconds
from benchmarking.runs import JobResult, loops, revision

FRAMES = MetricDefinition("frames", "sequence.frames")
LENGTH = MetricDefinition("path (m)", "sequence.length_m")
ERRORS = tuple(
    MetricDefinition(
        f"ATE {dof}-dof, {trajectory}", f"trajectories.{trajectory}.align.{dof}dof.ate_rmse_m", 2
    )
    for dof in "76"
    for trajectory in ("network", "odometry", "optimised")
)
ATE_7, ATE_6 = ERRORS[2], ERRORS[5]
R_REL = MetricDefinition(
    "r_rel (deg / 100 m)", "trajectories.optimised.align.7dof.r_rel_deg_per_100m", 2
)
SCALE = MetricDefinition("scale", "trajectories.optimised.align.7dof.scale", 3)
PERCENT = share("7-dof, % of path", ATE_7, LENGTH, 100.0)
PERCENT_6 = share("6-dof, % of path", ATE_6, LENGTH, 100.0)
NETWORK_PERCENT = share("network, % of path", ERRORS[0], LENGTH, 100.0)
OF_NETWORK = share("of network's", ATE_7, ERRORS[0], 1.0)
LOOPS = MetricDefinition("loops closed", "loops.accepted")
TRUE_LOOPS = MetricDefinition("true loops", lambda o: loops(o.job.place)[0])
FALSE_LOOPS = MetricDefinition("false loops", lambda o: loops(o.job.place)[1])
COVERAGE = MetricDefinition("coverage of 95 %", "graph.coverage.95", 2)
MAP_ERRORS = (
    MetricDefinition("accuracy, median (m)", "map.accuracy_median_m", 3),
    MetricDefinition("accuracy, 90 % (m)", "map.accuracy_90_m", 2),
    MetricDefinition("90 % where the scanner looked (m)", "map.in_field.accuracy_90_m", 2),
    MetricDefinition("completeness, 0.3 m", "map.completeness", 2),
    MetricDefinition("F-score, 0.2 m", "map.f_score.m02", 2),
    MetricDefinition("F-score, 0.5 m", "map.f_score.m05", 2),
    MetricDefinition("double walls", "map.double_wall_share", 4),
)
FUSED = MetricDefinition("frames fused", "map.frames_fused")
MAP_SIZES = (
    MetricDefinition("map triangles", "map.triangles"),
    MetricDefinition("blocks", "map.blocks"),
    MetricDefinition("submaps", "map.submaps"),
    FUSED,
    MetricDefinition("floaters", "map.floater_share", 3),
)
_MAP = MetricDefinition("map (s)", lambda o: stage_seconds(o, "map"), 1)
FUSION = share("fusion (ms / keyframe)", _MAP, FUSED, 1e3, 1)
MESH = MetricDefinition("mesh (s)", lambda o: stage_seconds(o, "mesh"), 1)
RATE = MetricDefinition("frames / s", "timing.frames_per_second", 1)
MEMORY = MetricDefinition("peak RSS (MiB)", "timing.peak_rss_mb")
SECONDS = MetricDefinition("seconds", "timing.seconds_total", 1)
TIME = share("ms / frame", SECONDS, FRAMES, 1e3, 1)
CPU = share("CPU ms / frame", MetricDefinition("CPU s", "timing.cpu_seconds", 1), FRAMES, 1e3, 1)
DEFINITIONS = (
    FRAMES,
    LENGTH,
    *ERRORS,
    PERCENT,
    PERCENT_6,
    NETWORK_PERCENT,
    OF_NETWORK,
    R_REL,
    SCALE,
)
DEFINITIONS += (LOOPS, TRUE_LOOPS, FALSE_LOOPS, COVERAGE, *MAP_ERRORS, *MAP_SIZES, FUSION, MESH)
DEFINITIONS += (RATE, MEMORY, SECONDS, TIME, CPU)


def rows(
    results: Sequence[JobResult], definitions: Sequence[MetricDefinition] = ()
) -> list[dict[str, Any]]:
    """One row a run for the CSV: what ran, what came out, also by more ``definitions``, seconds by stage."""
    commit = revision()
    return [
        {
            "sequence": o.job.drive.name,
            "weights": o.job.weights,
            "configuration": o.job.configuration,
            "seed": o.job.seed,
            "commit": commit,
            "status": "failed" if o.reason else "ok",
            "reason": o.reason,
            "leak": o.metrics.provenance.leak,
            **{q.title: q.value(o) for q in (*DEFINITIONS, *definitions)},
            **{f"stage {stage} (s)": stage_seconds(o, stage) for stage in stages(results)},
        }
        for o in results
    ]


def stages(results: Sequence[JobResult]) -> list[str]:
    """Every stage that some run went through, in order of appearance."""
    return list(dict.fromkeys(stage for o in results for stage in o.metrics.timing.stages or ()))
