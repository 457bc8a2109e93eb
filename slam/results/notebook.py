"""A run as a notebook shows it: errors, and the unit of lengths."""

from __future__ import annotations

from html import escape

from slam.results.folder import RunFolder
from slam.results.tables import errors_table
from slam.runtime.run_files import REPORT


def html(run: RunFolder) -> str:
    """The run as a piece of HTML without scripts."""
    metrics = run.metrics()
    title = f"{metrics.sequence.name or run.path.name}: {metrics.sequence.frames or 0} frames"
    errors = metrics.evaluated_errors()
    notes = [note for note in (metrics.failure, *metrics.unit_notes()) if note]
    if (run.path / REPORT).is_file():
        notes.append(f"Report: {run.path / REPORT}")
    table = errors_table(errors).html() if errors else ""
    return f"<h4>{escape(title)}</h4>{table}" + "".join(f"<p>{escape(note)}</p>" for note in notes)
