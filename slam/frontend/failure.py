"""The result of a measurement that failed."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MeasurementFailure:
    """Nothing was measured; ``reason`` says why, in words for the log and the report."""

    reason: str
