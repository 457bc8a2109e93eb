"""The metrics of a run, its row in the CSV, and Markdown tables whose rows are groups of runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from statistics import fmean, median, stdev
from typing import Any

from benchmarking.runs import JobResult, loops, ratio, revision, slug

from erfsfm.common.table import DASH, Table

Label = Callable[[JobResult], str]
Cell = Callable[[Sequence[JobResult]], str]
drive, kind, weights = attrgetter("job.drive.name"), attrgetter("job.drive.kind"), attrgetter("job.weights")
configuration = attrgetter("job.configuration.name")


@dataclass(frozen=True)
class MetricDefinition:
    """A metric of a run: its column in the CSV, its title in a table, its value, its decimals."""

    key: str
    title: str
    value: Callable[[JobResult], float | None]
    decimals: int


def _error(trajectory: str, alignment: str) -> MetricDefinition:
    def value(o: JobResult) -> float | None:
        error: float | None = o.metrics.at(f"trajectories.{trajectory}.align.{alignment}dof.ate_rmse_m")[0]
        return error

    title = f"ATE {alignment}-dof, {trajectory}"
    return MetricDefinition(f"ate_{alignment}dof_{trajectory}_m", title, value, 2)


def share(
    key: str, title: str, part: MetricDefinition, whole: MetricDefinition, unit: float, decimals: int = 2
) -> MetricDefinition:
    """A part of a whole, in a unit."""
    return MetricDefinition(key, title, lambda o: ratio(part.value(o), whole.value(o), unit), decimals)


def stage_seconds(o: JobResult, stage: str) -> float | None:
    """Seconds of a stage of a run."""
    return (o.metrics.timing.stages or {}).get(stage)


FRAMES = MetricDefinition("frames", "frames", lambda o: o.metrics.sequence.frames, 0)
LENGTH = MetricDefinition("length_m", "path (m)", lambda o: o.metrics.sequence.length_m, 0)
ERRORS = tuple(_error(trajectory, dof) for dof in "76" for trajectory in ("network", "odometry", "optimised"))
ATE_7, ATE_6 = ERRORS[2], ERRORS[5]
_R_REL, _SCALE = (
    attrgetter(f"metrics.trajectories.optimised.align.dof7.{name}") for name in ("r_rel_deg_per_100m", "scale")
)
R_REL = MetricDefinition("r_rel_deg_per_100m", "r_rel (deg / 100 m)", _R_REL, 2)
SCALE = MetricDefinition("scale", "scale", _SCALE, 3)
PERCENT = share("ate_7dof_optimised_percent", "7-dof, % of path", ATE_7, LENGTH, 100.0)
PERCENT_6 = share("ate_6dof_optimised_percent", "6-dof, % of path", ATE_6, LENGTH, 100.0)
NETWORK_PERCENT = share("ate_7dof_network_percent", "network, % of path", ERRORS[0], LENGTH, 100.0)
OF_NETWORK = share("ate_7dof_of_network", "of network's", ATE_7, ERRORS[0], 1.0)
LOOPS = MetricDefinition("loops_accepted", "loops closed", lambda o: o.metrics.loops.accepted, 0)
TRUE_LOOPS = MetricDefinition("loops_true", "true loops", lambda o: loops(o.job.place)[0], 0)
FALSE_LOOPS = MetricDefinition("loops_false", "false loops", lambda o: loops(o.job.place)[1], 0)
COVERAGE = MetricDefinition("coverage_95", "coverage of 95 %", lambda o: o.metrics.graph.coverage.inside_95, 2)
TRIANGLES = MetricDefinition("map_triangles", "map triangles", lambda o: o.metrics.map.triangles, 0)
MAP_ERRORS = (
    MetricDefinition("map_accuracy_median_m", "accuracy, median (m)", lambda o: o.metrics.map.accuracy_median_m, 3),
    MetricDefinition("map_accuracy_90_m", "90 % (m)", lambda o: o.metrics.map.accuracy_90_m, 2),
    MetricDefinition(
        "map_in_field_90_m", "90 % where the scanner looked (m)", lambda o: o.metrics.map.in_field.accuracy_90_m, 2
    ),
    MetricDefinition("map_completeness", "completeness, 0.3 m", lambda o: o.metrics.map.completeness, 2),
    MetricDefinition("map_f_score_02", "F-score, 0.2 m", lambda o: o.metrics.map.f_score.m02, 2),
    MetricDefinition("map_f_score_05", "0.5 m", lambda o: o.metrics.map.f_score.m05, 2),
    MetricDefinition("map_double_wall_share", "double walls", lambda o: o.metrics.map.double_wall_share, 4),
)
MAP_SIZES = (
    TRIANGLES,
    MetricDefinition("map_blocks", "blocks", lambda o: o.metrics.map.blocks, 0),
    MetricDefinition("map_submaps", "submaps", lambda o: o.metrics.map.submaps, 0),
    MetricDefinition("map_frames_fused", "frames fused", lambda o: o.metrics.map.frames_fused, 0),
    MetricDefinition("map_floater_share", "floaters", lambda o: o.metrics.map.floater_share, 3),
)
_MAP = MetricDefinition("map_seconds", "map (s)", lambda o: stage_seconds(o, "map"), 1)
FUSION = share("fusion_ms_per_keyframe", "fusion (ms / keyframe)", _MAP, MAP_SIZES[3], 1e3, 1)
MESH = MetricDefinition("mesh_seconds", "mesh (s)", lambda o: stage_seconds(o, "mesh"), 1)
RATE = MetricDefinition("frames_per_second", "frames / s", lambda o: o.metrics.timing.frames_per_second, 1)
MEMORY = MetricDefinition("peak_rss_mb", "peak RSS (MiB)", lambda o: o.metrics.timing.peak_rss_mb, 0)
SECONDS = MetricDefinition("seconds_total", "seconds", lambda o: o.metrics.timing.seconds_total, 1)
_CPU = MetricDefinition("cpu_seconds", "CPU s", lambda o: o.metrics.timing.cpu_seconds, 1)
TIME = share("ms_per_frame", "ms / frame", SECONDS, FRAMES, 1e3, 1)
CPU = share("cpu_ms_per_frame", "CPU ms / frame", _CPU, FRAMES, 1e3, 1)
DEFINITIONS = (FRAMES, LENGTH, *ERRORS, PERCENT, PERCENT_6, NETWORK_PERCENT, OF_NETWORK, R_REL, SCALE)
DEFINITIONS += (LOOPS, TRUE_LOOPS, FALSE_LOOPS, COVERAGE, TRIANGLES)
DEFINITIONS += (*MAP_ERRORS, *MAP_SIZES[1:], FUSION, MESH)
DEFINITIONS += (RATE, MEMORY, SECONDS, TIME, CPU)


def rows(results: Sequence[JobResult], definitions: Sequence[MetricDefinition] = ()) -> list[dict[str, Any]]:
    """One row a run for the CSV: what ran, what came out, also by more ``definitions``, seconds by stage."""
    commit = revision()
    return [
        {
            "sequence": o.job.drive.name,
            "weights": o.job.weights,
            "configuration": o.job.configuration.name,
            "seed": o.job.seed,
            "commit": commit,
            "status": "failed" if o.reason else "ok",
            "reason": o.reason,
            "leak": o.metrics.provenance.leak,
            **{q.key: q.value(o) for q in (*DEFINITIONS, *definitions)},
            **{f"seconds_{slug(stage)}": stage_seconds(o, stage) for stage in stages(results)},
        }
        for o in results
    ]


def stages(results: Sequence[JobResult]) -> list[str]:
    """Every stage that some run went through, in order of appearance."""
    return list(dict.fromkeys(stage for o in results for stage in o.metrics.timing.stages or ()))


def table(rows: Mapping[str, Label], columns: Mapping[str, Cell], results: Sequence[JobResult]) -> str:
    """Markdown: one row for each group of results that share their labels."""
    groups = grouped(results, *rows.values()).items()
    cells = [[*label, *(cell(group) for cell in columns.values())] for label, group in groups]
    return Table([*rows, *columns], cells, names=len(rows)).markdown()


def grouped(results: Sequence[JobResult], *labels: Label) -> dict[tuple[str, ...], list[JobResult]]:
    """Results grouped by their labels, in order of appearance."""
    groups: dict[tuple[str, ...], list[JobResult]] = {}
    for o in results:
        groups.setdefault(tuple(label(o) for label in labels), []).append(o)
    return groups


def over_seeds(definition: MetricDefinition) -> Cell:
    """Mean and, where it is not zero, sample standard deviation."""

    def cell(group: Sequence[JobResult]) -> str:
        found = values(group, definition)
        deviation = round(stdev(found), definition.decimals) if len(found) > 1 else 0.0
        return mean(found, definition.decimals) + (f" ± {deviation:.{definition.decimals}f}" if deviation else "")

    return cell


def average(definition: MetricDefinition) -> Cell:
    """Mean over a group."""
    return lambda group: mean(values(group, definition), definition.decimals)


def middle_and_extreme(definition: MetricDefinition, extreme: Callable[[Sequence[float]], float]) -> Cell:
    """Median and the largest or smallest value of a group."""
    return lambda group: spread(values(group, definition), definition.decimals, extreme)


def spread(found: Sequence[float], decimals: int, extreme: Callable[[Sequence[float]], float]) -> str:
    """Median and the largest or smallest of some numbers."""
    return f"{median(found):.{decimals}f} ({extreme(found):.{decimals}f})" if found else DASH


def values(results: Sequence[JobResult], definition: MetricDefinition) -> list[float]:
    """The values of a metric, without the results that lack it."""
    found = (definition.value(o) for o in results)
    return [value for value in found if value is not None]


def mean(found: Sequence[float], decimals: int) -> str:
    """Mean of some numbers."""
    return f"{fmean(found):.{decimals}f}" if found else DASH
