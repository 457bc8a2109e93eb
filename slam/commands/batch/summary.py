"""All drives of a batch in one CSV file, and as a table for a terminal."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from erfsfm.common.files import is_foreign
from slam.commands.batch.execution import LOG_BEGIN, Outcome
from slam.commands.batch.manifest import Drive
from slam.results.error_columns import written
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics
from slam.runtime.errors import RunError
from slam.runtime.storage.files import write_atomically
from slam.runtime.terminal import TerminalTable

CSV = "drives.csv"
_FIRST = ("drive", "status", "reason")
# column, its value, decimals on a terminal
_COLUMNS: tuple[tuple[str, Callable[[Metrics], object], int], ...] = (
    ("sequence", lambda m: m.sequence.name, 0),
    ("frames", lambda m: m.sequence.frames, 0),
    ("length_m", lambda m: m.sequence.length_m, 0),
    ("scale", lambda m: m.scale.mode, 0),
    ("unit", lambda m: m.unit, 0),
    ("ate_6dof_m", lambda m: m.trajectories.optimised.align.dof6.ate_rmse_m if m.is_metric else None, 3),
    ("ate_7dof_m", lambda m: m.trajectories.optimised.align.dof7.ate_rmse_m, 3),
    ("t_rel_percent", lambda m: m.trajectories.optimised.align.dof7.t_rel_percent, 2),
    ("r_rel_deg_per_100m", lambda m: m.trajectories.optimised.align.dof7.r_rel_deg_per_100m, 3),
    ("interpolated_frames", lambda m: m.sequence.bridged_frames, 0),
    ("loops", lambda m: m.loops.accepted, 0),
    ("map_triangles", lambda m: m.map.triangles, 0),
    ("leak", lambda m: m.provenance.leak, 0),
    ("seconds", lambda m: m.timing.seconds_total, 1),
    ("frames_per_second", lambda m: m.timing.frames_per_second, 1),
    ("peak_rss_mb", lambda m: m.timing.peak_rss_mb, 0),
)


def check_output(output: Path, drives: Sequence[Drive]) -> None:
    """Check that a batch of these drives may be written to a folder.

    Raises:
        RunError: a file, or a folder of other files with the names of a summary or of a log.
    """
    if output.exists() and not output.is_dir():
        raise RunError(f"{output} is a file: give a folder as --output")
    if CSV in {drive.name for drive in drives}:
        raise RunError(f"a drive is named {CSV}, as a file of the batch: give it another name in the manifest")
    logs = [(f"{drive.name}.log", LOG_BEGIN) for drive in drives]
    for name, mark in ((CSV, ",".join(_FIRST)), *logs):
        path = output / name
        if is_foreign(path, mark):
            raise RunError(f"{path} is none of ours and would be replaced: choose another --output")


def write_summary(output: Path, outcomes: Sequence[Outcome]) -> None:
    """Write ``drives.csv``, whole or not at all."""
    rows = [_row(outcome) for outcome in outcomes]
    names = [*_FIRST, *(name for name, _, _ in _COLUMNS)]

    def fill(path: Path) -> None:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(rows)

    write_atomically(output / CSV, fill, RunError)


def summary_table(outcomes: Sequence[Outcome]) -> TerminalTable:
    """The main numbers of the runs that are whole, and why others failed, for a terminal."""
    shown = ("frames", "length_m", "unit", "ate_6dof_m", "ate_7dof_m", "t_rel_percent", "seconds")
    rows = []
    for outcome in outcomes:
        if outcome.status != "failed":
            row = _row(outcome)
            cells = (written(row[name], decimals) for name, _, decimals in _COLUMNS if name in shown)
            rows.append([outcome.drive.name, outcome.status, *cells])
    head = ["drive", "status", "frames", "length\nm", "unit", "ATE m\n6dof", "ATE m\n7dof", "t_rel %\n7dof", "seconds"]
    notes = [f"{outcome.drive.name} failed: {outcome.reason}" for outcome in outcomes if outcome.status == "failed"]
    return TerminalTable(head, rows, notes=notes)


def _row(outcome: Outcome) -> dict[str, Any]:
    row: dict[str, Any] = {"drive": outcome.drive.name, "status": outcome.status, "reason": outcome.reason}
    if outcome.status == "failed":
        return row | {name: None for name, _, _ in _COLUMNS}
    metrics = RunFolder(outcome.folder).metrics()
    return row | {name: value(metrics) for name, value, _ in _COLUMNS}
