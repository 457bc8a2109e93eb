"""A metric of a run: its title, its source, its decimals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from benchmarking.runs import JobResult


@dataclass(frozen=True)
class MetricDefinition:
    """A number of a run: its title in tables and in the CSV, its source, its decimals.

    The source is its path in ``metrics.json`` as in `Metrics.at`, or a function of the run.
    """

    title: str
    source: str | Callable[[JobResult], float | None]
    decimals: int = 0

    def value(self, o: JobResult) -> float | None:
        """The number; None where it is not known."""
        found: float | None = (
            o.metrics.at(self.source)[0] if isinstance(self.source, str) else self.source(o)
        )
        return found


def share(
    title: str, part: MetricDefinition, whole: MetricDefinition, unit: float, decimals: int = 2
) -> MetricDefinition:
    """A part of a whole, in a unit."""

    def value(o: JobResult) -> float | None:
        of, total = part.value(o), whole.value(o)
        return None if of is None or not total else unit * of / total

    return MetricDefinition(title, value, decimals)


def stage_seconds(o: JobResult, stage: str) -> float | None:
    """Seconds of a stage of a run."""
    return (o.metrics.timing.stages or {}).get(stage)
