"""One row for each kind of drive: median and worst errors, closed loops, errors with hazards over those without."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarking.cells import Cell, middle_and_extreme, spread, table, values, weights
from benchmarking.metric_definitions import (
    ATE_7,
    CPU,
    FALSE_LOOPS,
    MEMORY,
    NETWORK_PERCENT,
    OF_NETWORK,
    PERCENT,
    RATE,
    TRUE_LOOPS,
)
from benchmarking.work import JobResult


def summary_table(results: Sequence[JobResult]) -> str:
    """One row for each kind of drive and weights; every number is over all of its runs."""
    columns: dict[str, Cell] = {
        "runs": lambda group: str(len(group)),
        "failed": lambda group: str(sum(bool(o.reason) for o in group)),
        "ATE, % of path: median (worst)": middle_and_extreme(PERCENT, max),
        "the network's": middle_and_extreme(NETWORK_PERCENT, max),
        "over the network's": middle_and_extreme(OF_NETWORK, max),
        "over the clean drive's": against_clean(results),
        "drives with a true loop": found,
        "false loops": lambda group: f"{sum(values(group, FALSE_LOOPS)):.0f}",
        "frames / s": middle_and_extreme(RATE, min),
        "CPU ms / frame": middle_and_extreme(CPU, max),
        "peak RSS (MiB)": middle_and_extreme(MEMORY, max),
    }
    return table({"drives": kind, "weights": weights}, columns, results)


def kind(o: JobResult) -> str:
    """Kind of the drive."""
    return o.job.drive.kind


def found(group: Sequence[JobResult]) -> str:
    """Number of runs with at least one true accepted loop."""
    return f"{sum(count > 0 for count in values(group, TRUE_LOOPS))} of {len(group)}"


def against_clean(results: Sequence[JobResult]) -> Cell:
    """Optimised 7-dof errors over those of the same drives without hazards."""

    def key(name: str, o: JobResult) -> tuple[str, str, str, int]:
        return name, o.job.weights, o.job.configuration.name, o.job.seed

    by_run = {key(o.job.drive.name, o): o for o in results}

    def cell(group: Sequence[JobResult]) -> str:
        twins = [(o, by_run[key(o.job.drive.clean, o)]) for o in group if key(o.job.drive.clean, o) in by_run]
        pairs = [(values([o], ATE_7), values([twin], ATE_7)) for o, twin in twins]
        return spread([ate / clean for [ate], [clean] in (p for p in pairs if all(p)) if clean > 0], 2, max)

    return cell
