"""All drives of a batch in one CSV file and one page."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Any
from urllib.parse import quote

from erfsfm.common.files import is_foreign
from slam.commands.batch.execution import LOG_BEGIN, Outcome
from slam.commands.batch.manifest import Drive
from slam.formats.trajectory import Trajectory
from slam.results.error_columns import written
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics
from slam.results.report.rendering import Picture, render
from slam.results.report.tables import Cell, Table
from slam.results.report.verdict import verdict
from slam.runtime.errors import RunError, SlamError
from slam.runtime.run_files import REPORT
from slam.runtime.storage.files import write_atomically
from slam.runtime.storage.record import Missing, known
from slam.runtime.terminal import TerminalTable

CSV = "drives.csv"
PAGE = "index.html"
_FIRST = ("drive", "status", "reason")
# column, its value, decimals on the page
_COLUMNS: tuple[tuple[str, Callable[[Metrics], object], int], ...] = (
    ("sequence", lambda m: m.sequence.name, 0),
    ("frames", lambda m: m.sequence.frames, 0),
    ("length_m", lambda m: m.sequence.length_m, 0),
    ("scale", lambda m: m.scale.mode, 0),
    ("unit", lambda m: m.unit, 0),
    ("ate_6dof_m", lambda m: m.trajectories.optimised.align.dof6.ate_rmse_m if m.is_metric else Missing(), 3),
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
_MOST_DRAWN = 100
_NOTE = (
    "Errors are those of the optimised trajectory, with 6 dof only where its unit is metres; a dash is a number that "
    "cannot be computed, the report of its run says why."
)


def check_output(output: Path, drives: Sequence[Drive]) -> None:
    """Check that a batch of these drives may be written to a folder.

    Raises:
        RunError: a file, or a folder of other files with the names of a summary or of a log.
    """
    if output.exists() and not output.is_dir():
        raise RunError(f"{output} is a file: give a folder as --output")
    for name in {drive.name for drive in drives} & {CSV, PAGE}:
        raise RunError(f"a drive is named {name}, as a file of the batch: give it another name in the manifest")
    logs = [(f"{drive.name}.log", LOG_BEGIN) for drive in drives]
    for name, mark in ((CSV, ",".join(_FIRST)), (PAGE, "<title>erfsfm-slam: "), *logs):
        path = output / name
        if is_foreign(path, mark):
            raise RunError(f"{path} is none of ours and would be replaced: choose another --output")


def write_summary(output: Path, outcomes: Sequence[Outcome]) -> None:
    """Write ``drives.csv`` and ``index.html``, each whole or not at all."""
    rows = [_row(outcome) for outcome in outcomes]
    names = [*_FIRST, *(name for name, _, _ in _COLUMNS)]

    def fill(path: Path) -> None:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(rows)

    write_atomically(output / CSV, fill, RunError)
    page = _page(outcomes, rows, output)
    write_atomically(output / PAGE, lambda path: path.write_text(page, encoding="utf-8"), RunError)


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
    return row | {name: known(value(metrics)) for name, value, _ in _COLUMNS}


def _page(outcomes: Sequence[Outcome], rows: Sequence[dict[str, Any]], output: Path) -> str:
    """The page: what all runs say together, each in a row, their plots, and the verdict of each."""
    whole = [(outcome, row) for outcome, row in zip(outcomes, rows) if outcome.status != "failed"]
    failed = [[Cell(o.drive.name), Cell(o.reason)] for o in outcomes if o.status == "failed"]
    cells = [[_named(o, output), *(Cell(_text(row[name], n)) for name, _, n in _COLUMNS)] for o, row in whole]
    verdicts = [(o, verdict(RunFolder(o.folder).metrics())) for o, _ in whole]
    errors = {row["drive"]: error for _, row in whole if (error := _error_percent(row)) is not None}
    head = ("drive", *(name.replace("_", " ") for name, _, _ in _COLUMNS))
    return render(
        "index.html.j2",
        drives=len(outcomes),
        whole=len(whole),
        sentence=_sentence(errors),
        failed=Table((), failed, "words") if failed else None,
        runs=Table(head, cells, notes=[_NOTE]) if cells else None,
        plots=list(_plots([o for o, _ in whole], errors)),
        verdicts=Table(
            ("drive", "verdict", "doubts"),
            [[_named(o, output), Cell(v.sentence), Cell("; ".join(v.doubts))] for o, v in verdicts if v is not None],
            "words",
        ),
    )


def _plots(whole: Sequence[Outcome], errors: Mapping[str, float]) -> Iterator[Picture]:
    from slam.results.report.figures import bars_figure, drives_figure

    if errors:
        figure = bars_figure(errors, "position error (% of the path)")
        yield Picture.of_plot("Error of each drive", "6 dof where lengths are metres, else 7 dof.", figure)
    drives: dict[str, Trajectory] = {}
    for o in whole[:_MOST_DRAWN]:
        with suppress(SlamError):
            if (trajectory := RunFolder(o.folder).trajectory("optimised")) is not None:
                drives[o.drive.name] = trajectory
    more = f" The first {_MOST_DRAWN} drives." if len(whole) > _MOST_DRAWN else ""
    if drives:
        caption = f"Optimised trajectories from one start, each in its own unit.{more}"
        yield Picture.of_plot("Trajectories from above", caption, drives_figure(drives))


def _error_percent(row: Mapping[str, Any]) -> float | None:
    """Position error over the path, where both are known."""
    error = row["ate_7dof_m"] if row["ate_6dof_m"] is None else row["ate_6dof_m"]
    return None if error is None or not row["length_m"] else 100.0 * float(error) / float(row["length_m"])


def _sentence(errors: Mapping[str, float]) -> str:
    if not errors:
        return ""
    worst = max(errors, key=lambda name: errors[name])
    return (
        f"Of the drives with a truth ({len(errors)}), the position error is {median(errors.values()):.2g} % of the "
        f"path in the median, and {errors[worst]:.2g} % at worst ({worst})."
    )


def _named(outcome: Outcome, output: Path) -> Cell:
    """A drive with the address of its report, if there is one."""
    report = outcome.folder / REPORT
    address = quote(os.path.relpath(report, output.absolute())) if report.is_file() else ""
    return Cell(outcome.drive.name, address=address)


def _text(value: Any, decimals: int) -> str:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else written(value, decimals)
