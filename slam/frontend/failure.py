"""The result of a measurement that failed."""

from __future__ import annotations

from dataclasses import dataclass

from slam.runtime.attempt import Failed


@dataclass(frozen=True)
class MeasurementFailure(Failed):
    """No measurement; ``reason`` is a text for the log and the report."""
