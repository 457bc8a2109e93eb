"""Markdown tables: results grouped into rows, and the text of a cell for a group."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from statistics import fmean, median, stdev

from benchmarking.metric_definitions import MetricDefinition
from benchmarking.work import JobResult

from slam.results.error_columns import DASH
from slam.runtime.storage.record import Missing

Label = Callable[[JobResult], str]
Cell = Callable[[Sequence[JobResult]], str]


def table(rows: Mapping[str, Label], columns: Mapping[str, Cell], results: Sequence[JobResult]) -> str:
    """Markdown: one row for each group of results that share their labels."""
    lines = ["| " + " | ".join([*rows, *columns]) + " |", "|" + "---|" * len(rows) + "---:|" * len(columns)]
    for label, group in grouped(results, *rows.values()).items():
        lines.append("| " + " | ".join([*label, *(cell(group) for cell in columns.values())]) + " |")
    return "\n".join(lines)


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


def average_among(definition: MetricDefinition, among: Sequence[JobResult]) -> Cell:
    """Mean over the results of a group that are also in another one."""
    return lambda group: mean(values([o for o in group if o in among], definition), definition.decimals)


def middle_and_extreme(definition: MetricDefinition, extreme: Callable[[Sequence[float]], float]) -> Cell:
    """Median and the largest or smallest value of a group."""
    return lambda group: spread(values(group, definition), definition.decimals, extreme)


def spread(found: Sequence[float], decimals: int, extreme: Callable[[Sequence[float]], float]) -> str:
    """Median and the largest or smallest of some numbers."""
    return f"{median(found):.{decimals}f} ({extreme(found):.{decimals}f})" if found else DASH


def values(results: Sequence[JobResult], definition: MetricDefinition) -> list[float]:
    """The values of a metric, without the results that lack it."""
    found = (definition.value(o) for o in results)
    return [value for value in found if not isinstance(value, Missing)]


def mean(found: Sequence[float], decimals: int) -> str:
    """Mean of some numbers."""
    return f"{fmean(found):.{decimals}f}" if found else DASH


def drive(o: JobResult) -> str:
    """Name of the recording."""
    return o.job.drive.name


def weights(o: JobResult) -> str:
    """Name of the weights."""
    return o.job.weights


def configuration(o: JobResult) -> str:
    """Name of the configuration."""
    return o.job.configuration.name
