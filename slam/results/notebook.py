"""A run as a notebook shows it: errors, the unit of lengths, and the map from above."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from html import escape

from slam.results.error_columns import COLUMNS, written
from slam.results.folder import RunFolder
from slam.runtime.run_files import MAP_ABOVE, REPORT
from slam.runtime.storage.record import known


def html(run: RunFolder) -> str:
    """The run as a piece of HTML without scripts."""
    metrics, picture = run.metrics(), run.path / MAP_ABOVE
    rows = [
        [name, *(written(column.value(errors), column.decimals) for column in COLUMNS)]
        for name, errors in metrics.evaluated_errors().items()
    ]
    table = _row(["", *(column.name for column in COLUMNS)], "th") + "".join(_row(row, "td") for row in rows)
    title = f"{known(metrics.sequence.name) or run.path.name}: {known(metrics.sequence.frames) or 0} frames"
    notes = [note for note in (metrics.failure, *metrics.unit_notes()) if note]
    if (run.path / REPORT).is_file():
        notes.append(f"Report: {run.path / REPORT}")
    parts = [f"<h4>{escape(title)}</h4>", f"<table>{table}</table>" if rows else ""]
    parts += [f"<p>{escape(note)}</p>" for note in notes]
    if picture.is_file():
        encoded = b64encode(picture.read_bytes()).decode()
        parts.append(f'<img alt="the map from above" style="max-width: 100%" src="data:image/png;base64,{encoded}">')
    return "".join(parts)


def _row(cells: Sequence[str], tag: str) -> str:
    return f"<tr>{''.join(f'<{tag}>{escape(cell)}</{tag}>' for cell in cells)}</tr>"
