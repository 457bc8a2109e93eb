"""The numbers of a run and its row in the CSV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from benchmarking.plan import slug
from benchmarking.work import Outcome

from slam.results.comparison import lookup


@dataclass(frozen=True)
class Quantity:
    """A number of an outcome: its column in the CSV, its title in a table, where it stands, its decimals."""

    key: str
    title: str
    path: tuple[str, ...]
    decimals: int


def _error(trajectory: str, alignment: str) -> Quantity:
    path = ("trajectories", trajectory, "align", f"{alignment}dof", "ate_rmse_m")
    return Quantity(f"ate_{alignment}dof_{trajectory}_m", f"ATE {alignment}-dof, {trajectory}", path, 2)


STAGES = ("timing", "stages")
_ALIGNED = ("trajectories", "optimised", "align", "7dof")
FRAMES = Quantity("frames", "frames", ("sequence", "frames"), 0)
LENGTH = Quantity("length_m", "path (m)", ("sequence", "length_m"), 0)
ERRORS = tuple(_error(trajectory, dof) for dof in "76" for trajectory in ("network", "odometry", "optimised"))
ATE_7, ATE_6 = ERRORS[2], ERRORS[5]
R_REL = Quantity("r_rel_deg_per_100m", "r_rel (deg / 100 m)", (*_ALIGNED, "r_rel_deg_per_100m"), 2)
SCALE = Quantity("scale", "scale", (*_ALIGNED, "scale"), 3)
PERCENT = Quantity("ate_7dof_optimised_percent", "% of path", ("judgement", "optimised_percent"), 2)
NETWORK_PERCENT = Quantity("ate_7dof_network_percent", "network, % of path", ("judgement", "network_percent"), 2)
OF_NETWORK = Quantity("ate_7dof_of_network", "of network's", ("judgement", "of_network"), 2)
LOOPS = Quantity("loops_accepted", "loops closed", ("loops", "accepted"), 0)
TRUE_LOOPS = Quantity("loops_true", "true loops", ("judgement", "true_loops"), 0)
FALSE_LOOPS = Quantity("loops_false", "false loops", ("judgement", "false_loops"), 0)
COVERAGE = Quantity("coverage_95", "coverage of 95 %", ("graph", "coverage", "95"), 2)
TRIANGLES = Quantity("map_triangles", "map triangles", ("map", "triangles"), 0)
RATE = Quantity("frames_per_second", "frames / s", ("timing", "frames_per_second"), 1)
MEMORY = Quantity("peak_rss_mb", "peak RSS (MiB)", ("timing", "peak_rss_mb"), 0)
SECONDS = Quantity("seconds_total", "seconds", ("timing", "seconds_total"), 1)
COMMAND = Quantity("command_seconds", "whole command (s)", ("process", "seconds"), 1)
LOAD = Quantity("load_average", "load before", ("process", "load"), 1)
TIME = Quantity("ms_per_frame", "ms / frame", ("process", "ms_per_frame"), 1)
CPU = Quantity("cpu_ms_per_frame", "CPU ms / frame", ("process", "cpu_ms_per_frame"), 1)
QUANTITIES = (FRAMES, LENGTH, *ERRORS, PERCENT, NETWORK_PERCENT, OF_NETWORK, R_REL, SCALE)
QUANTITIES += (LOOPS, TRUE_LOOPS, FALSE_LOOPS, COVERAGE, TRIANGLES)
QUANTITIES += (RATE, MEMORY, SECONDS, TIME, CPU, COMMAND, LOAD)


def rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
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
            **{q.key: lookup(o.metrics, *q.path)[0] for q in QUANTITIES},
            **{f"seconds_{slug(stage)}": lookup(o.metrics, *STAGES, stage)[0] for stage in stages(outcomes)},
        }
        for o in outcomes
    ]


def stages(outcomes: Sequence[Outcome]) -> list[str]:
    """Every stage that some run went through, in order of appearance."""
    return list(dict.fromkeys(stage for o in outcomes for stage in lookup(o.metrics, *STAGES)[0] or ()))
