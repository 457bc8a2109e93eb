"""The result of a measurement that failed."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MeasurementFailure:
    """No measurement; ``reason`` is a text for the log and the report."""

    reason: str
