"""Markdown tables: groups of outcomes and what a cell says of a group."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from statistics import fmean, median, stdev

from benchmarking.metric_definitions import Quantity
from benchmarking.work import Outcome

from slam.results.comparison import MISSING, lookup

Label = Callable[[Outcome], str]
Cell = Callable[[Sequence[Outcome]], str]


def table(rows: Mapping[str, Label], columns: Mapping[str, Cell], outcomes: Sequence[Outcome]) -> str:
    """Markdown: one row for each group of outcomes that share their labels."""
    lines = ["| " + " | ".join([*rows, *columns]) + " |", "|" + "---|" * len(rows) + "---:|" * len(columns)]
    for label, group in grouped(outcomes, *rows.values()).items():
        lines.append("| " + " | ".join([*label, *(cell(group) for cell in columns.values())]) + " |")
    return "\n".join(lines)


def grouped(outcomes: Sequence[Outcome], *labels: Label) -> dict[tuple[str, ...], list[Outcome]]:
    """Outcomes by what they share, in order of appearance."""
    groups: dict[tuple[str, ...], list[Outcome]] = {}
    for o in outcomes:
        groups.setdefault(tuple(label(o) for label in labels), []).append(o)
    return groups


def over_seeds(quantity: Quantity) -> Cell:
    """Mean and, where it is more than nothing, sample standard deviation."""

    def cell(group: Sequence[Outcome]) -> str:
        found = values(group, quantity)
        deviation = round(stdev(found), quantity.decimals) if len(found) > 1 else 0.0
        return mean(found, quantity.decimals) + (f" ± {deviation:.{quantity.decimals}f}" if deviation else "")

    return cell


def average(quantity: Quantity) -> Cell:
    """Mean over a group."""
    return lambda group: mean(values(group, quantity), quantity.decimals)


def average_among(quantity: Quantity, among: Sequence[Outcome]) -> Cell:
    """Mean over those of a group that are among others too."""
    return lambda group: mean(values([o for o in group if o in among], quantity), quantity.decimals)


def middle_and_extreme(quantity: Quantity, extreme: Callable[[Sequence[float]], float]) -> Cell:
    """Median and the largest or smallest value of a group."""
    return lambda group: spread(values(group, quantity), quantity.decimals, extreme)


def spread(found: Sequence[float], decimals: int, extreme: Callable[[Sequence[float]], float]) -> str:
    """Median and the largest or smallest of some numbers."""
    return f"{median(found):.{decimals}f} ({extreme(found):.{decimals}f})" if found else MISSING


def values(outcomes: Sequence[Outcome], quantity: Quantity) -> list[float]:
    """A number of all outcomes that have it."""
    found = (lookup(o.metrics, *quantity.path)[0] for o in outcomes)
    return [value for value in found if value is not None]


def mean(found: Sequence[float], decimals: int) -> str:
    """Mean of some numbers."""
    return f"{fmean(found):.{decimals}f}" if found else MISSING


def drive(o: Outcome) -> str:
    """Name of the recording."""
    return o.job.drive.name


def weights(o: Outcome) -> str:
    """Name of the weights."""
    return o.job.weights


def configuration(o: Outcome) -> str:
    """Name of the configuration."""
    return o.job.configuration.name
