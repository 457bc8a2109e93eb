"""Markdown tables whose rows are groups of runs and whose cells are numbers over a group."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from statistics import fmean, median, stdev

from benchmarking.definitions import MetricDefinition
from benchmarking.runs import JobResult

from erfsfm.common.table import DASH, Table

Label = Callable[[JobResult], str]
Cell = Callable[[Sequence[JobResult]], str]
drive = attrgetter("job.drive.name")
kind = attrgetter("job.drive.kind")
weights = attrgetter("job.weights")
configuration = attrgetter("job.configuration")


def table(
    rows: Mapping[str, Label], columns: Mapping[str, Cell], results: Sequence[JobResult]
) -> str:
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
        return mean(found, definition.decimals) + (
            f" ± {deviation:.{definition.decimals}f}" if deviation else ""
        )

    return cell


def middle_and_extreme(
    definition: MetricDefinition, extreme: Callable[[Sequence[float]], float]
) -> Cell:
    """Median and the largest or smallest value of a group."""
    return lambda group: spread(values(group, definition), definition.decimals, extreme)


def spread(
    found: Sequence[float], decimals: int, extreme: Callable[[Sequence[float]], float]
) -> str:
    """Median and the largest or smallest of some numbers."""
    return f"{median(found):.{decimals}f} ({extreme(found):.{decimals}f})" if found else DASH


def values(results: Sequence[JobResult], definition: MetricDefinition) -> list[float]:
    """The values of a metric, without the results that lack it."""
    found = (definition.value(o) for o in results)
    return [value for value in found if value is not None]


def mean(found: Sequence[float], decimals: int) -> str:
    """Mean of some numbers."""
    return f"{fmean(found):.{decimals}f}" if found else DASH
