"""A run as a notebook shows it: errors, and the unit of lengths."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from slam.results.error_columns import COLUMNS, written
from slam.results.folder import RunFolder
from slam.runtime.run_files import REPORT


def html(run: RunFolder) -> str:
    """The run as a piece of HTML without scripts."""
    metrics = run.metrics()
    rows = [
        [name, *(written(errors.at(column.path)[0], column.decimals) for column in COLUMNS)]
        for name, errors in metrics.evaluated_errors().items()
    ]
    table = _row(["", *(column.name for column in COLUMNS)], "th") + "".join(_row(row, "td") for row in rows)
    title = f"{metrics.sequence.name or run.path.name}: {metrics.sequence.frames or 0} frames"
    notes = [note for note in (metrics.failure, *metrics.unit_notes()) if note]
    if (run.path / REPORT).is_file():
        notes.append(f"Report: {run.path / REPORT}")
    parts = [f"<h4>{escape(title)}</h4>", f"<table>{table}</table>" if rows else ""]
    parts += [f"<p>{escape(note)}</p>" for note in notes]
    return "".join(parts)


def _row(cells: Sequence[str], tag: str) -> str:
    return f"<tr>{''.join(f'<{tag}>{escape(cell)}</{tag}>' for cell in cells)}</tr>"
