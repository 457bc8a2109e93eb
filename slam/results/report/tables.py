"""The tables of a report, from ``metrics.json``; every missing number shows its reason."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from slam.evaluation.trajectory import ALIGNMENTS
from slam.results.error_columns import (
    ALIGNED_ATE,
    COLUMNS,
    DASH,
    EVO_DIFFERENCE,
    R_REL,
    RPE_DEG,
    RPE_M,
    SNIPPET_ATE,
    SNIPPET_RE,
    T_REL,
    ErrorColumn,
    written,
)
from slam.results.metrics import CAMERA_HEIGHTS, METRES, GpsErrors, LoopsFile, Metrics, Stretch
from slam.runtime.run_files import LOOPS, METRICS
from slam.runtime.storage.record import NOT_RECORDED, Record


@dataclass(frozen=True)
class Cell:
    """A table cell: its text or a bar of ``bar`` percent, a tooltip, a style (``best``, ``missing``) and a link."""

    text: str
    tooltip: str = ""
    style: str = ""
    bar: float | None = None
    address: str = ""


@dataclass(frozen=True)
class Table:
    """Cells row by row; a row that is a string heads the rows below it. Notes stand under the table."""

    head: Sequence[str]
    rows: Sequence[Sequence[Cell] | str]
    style: str = ""
    notes: Sequence[str] = field(default_factory=tuple)


MOST_LOOPS = 40
_PER_ALIGNMENT = (
    ("ate_rmse_m", "ATE RMSE, m", 3),
    ("t_rel_percent", "t_rel, %", 2),
    ("r_rel_deg_per_100m", "r_rel, deg / 100 m", 3),
    ("rpe_trans_m", "RPE, m", 4),
    ("rpe_rot_deg", "RPE, deg", 4),
    ("scale", "scale", 4),
)


def number(record: Record, path: str, decimals: int = 0) -> Cell:
    """A value of the metrics as a cell; a dash with its reason as a tooltip where it is missing."""
    value, reason = record.at(path)
    if value is None:
        return Cell(DASH, reason, "missing")
    return Cell(f"{value:,}" if isinstance(value, int) else written(value, decimals))


def key_numbers(metrics: Metrics) -> list[tuple[str, Cell, str]]:
    """The key numbers that there are: name, value and unit of each."""
    best = metrics.trajectories.optimised
    fitted = ("dof6", "m, 6 dof") if metrics.is_metric else ("dof7", "m, 7 dof")
    wanted = [
        ("Position error", number(best, f"align.{fitted[0]}.ate_rmse_m", 2), fitted[1]),
        ("Drift, t_rel", number(best, T_REL.path, 2), "%"),
        ("Path", number(metrics, "sequence.length_m"), "m"),
        ("Frames", number(metrics, "sequence.frames"), ""),
        ("Speed", number(metrics, "timing.frames_per_second", 1), "frames/s"),
        ("Loops accepted", number(metrics, "loops.accepted"), ""),
        ("Map triangles", number(metrics, "map.triangles"), ""),
    ]
    return [(name, cell, unit) for name, cell, unit in wanted if cell.style != "missing"]


def what_ran(metrics: Metrics) -> Table:
    """Sequence, weights, scale and command; a run that failed early has fewer rows."""

    def text(path: str, decimals: int = 1, unit: str = "", most: int | None = None) -> str:
        value, reason = metrics.at(path)
        return f"{DASH} ({reason})" if value is None else f"{written(value, decimals)[:most]}{unit}"

    sequence, ran = metrics.sequence, metrics.provenance
    rows = [
        ("Sequence", f"{text('sequence.name')}, {text('sequence.frames')} frames"),
        ("Interpolated frames", _stretches(sequence.bridged) or "none"),
        *([("Doubled frames", doubled)] if (doubled := _stretches(sequence.doubled)) else []),
        *([("LiDAR scans left out", left_out)] if (left_out := _stretches(sequence.unreadable_scans)) else []),
        ("True length", text("sequence.length_m", unit=" m")),
        ("Frame rate", text("sequence.fps", unit=" frames/s")),
        ("Scale", _scale(metrics)),
        ("Speed", text("timing.frames_per_second", unit=" frames/s over the whole run")),
        ("Weights", f"{text('provenance.weights')}, sha256 {text('provenance.weights_sha256', most=16)}"),
        ("Depth", _depth_source(metrics)),
        ("Licence of the weights", text("provenance.weights_licence")),
        ("Trained on", _shortened(ran.trained_on or ()) or DASH),
        ("Leak", {True: "yes: trained on this sequence", False: "none known", None: DASH}[ran.leak]),
        ("Command", text("provenance.command")),
        ("Seed, device", f"{text('provenance.seed')}, {text('provenance.device')}"),
        ("Version, commit", f"{text('provenance.version')}, {text('provenance.commit')}"),
    ]
    recorded = [row for row in rows if NOT_RECORDED not in row[1]] if metrics.failure else rows
    return Table((), _texts(recorded), "words")


def _scale(metrics: Metrics) -> str:
    scale = metrics.scale
    if scale.value is None:
        return f"mode {scale.mode or DASH}, {scale.why('value')}"
    spread, frames = scale.spread, scale.frames_used
    unit = metrics.unit if metrics.unit in (METRES, CAMERA_HEIGHTS) else "units of the result"
    certain = "" if spread is None else f", spread {100 * spread:.1f} %"
    used = "" if frames is None else f", measured in {frames} frames"
    return f"mode {scale.mode}: one unit of the networks is {scale.value:.4g} {unit}{certain}{used}"


def gps(metrics: Metrics) -> Table | None:
    """Distances from the GPS track; None without one."""
    found = metrics.gps
    if found.absent:
        return None

    def row(name: str, errors: GpsErrors) -> list[Cell]:
        values = ("horizontal_rmse_m", "horizontal_median_m", "vertical_rmse_m")
        return [Cell(name), *(number(errors, value, 2) for value in values)]

    factors = "factors of the pose graph: the optimised row is no independent test"
    use = factors if found.in_graph is True else "not in the pose graph"
    notes = [f"{found.fixes} fixes, {use}. Both trajectories are turned and moved onto the track, not scaled."]
    head = ("", "horizontal RMSE, m", "horizontal median, m", "vertical RMSE, m")
    return Table(head, [row("odometry", found.odometry), row("optimised", found.optimised)], notes=notes)


def no_errors(metrics: Metrics) -> str:
    """Why no trajectory has an error; empty where one has, or where nothing was evaluated."""
    values = [errors.at(column.path) for column in COLUMNS for errors in metrics.evaluated_errors().values()]
    missing = [reason for value, reason in values if value is None]
    return missing[0] if values and len(missing) == len(values) else ""


def errors(metrics: Metrics) -> Table | None:
    """Every trajectory against the truth, a column each; None where nothing was evaluated."""
    evaluated = metrics.evaluated_errors()
    if not evaluated or no_errors(metrics):
        return None

    def row(column: ErrorColumn) -> list[Cell]:
        values = [each.at(column.path)[0] for each in evaluated.values()]
        numbers = {value for value in values if value is not None}
        least = min(numbers) if column is not EVO_DIFFERENCE and len(numbers) > 1 else None
        cells = [number(each, column.path, column.decimals) for each in evaluated.values()]
        styles = ["best" if value is not None and value == least else cell.style for value, cell in zip(values, cells)]
        texts = [column.text(each) for each in evaluated.values()]
        return [
            Cell(column.name),
            *(Cell(text, cell.tooltip, style) for text, cell, style in zip(texts, cells, styles)),
        ]

    rows: list[Sequence[Cell] | str] = [
        "Snippets of five frames, each with its own scale; ATE is norm / 5",
        *(row(column) for column in (SNIPPET_ATE, SNIPPET_RE)),
        "Whole trajectory: position error in metres, by alignment",
        *(row(column) for column in ALIGNED_ATE),
        "KITTI segments of 100 to 800 m",
        *(row(column) for column in (T_REL, R_REL)),
        "From frame to frame",
        *(row(column) for column in (RPE_M, RPE_DEG)),
        "Cross-check",
        row(EVO_DIFFERENCE),
    ]
    notes = ["Bold: the best of a row.", *notes_on(_missing_errors(metrics))]
    return Table(["", *evaluated], rows, notes=notes)


def alignments(metrics: Metrics) -> Table | None:
    """Every statistic of every trajectory under every alignment; None where nothing was evaluated."""
    if no_errors(metrics):
        return None
    rows: list[Sequence[Cell] | str] = []
    for name, found in metrics.evaluated_errors().items():
        if found.align.absent:
            continue
        rows.append(name)
        for how in ALIGNMENTS:
            cells = [number(found, f"align.{how}.{key}", decimals) for key, _, decimals in _PER_ALIGNMENT]
            rows.append([Cell(how), *cells])
    return Table(["alignment", *(label for _, label, _ in _PER_ALIGNMENT)], rows) if rows else None


def loops(metrics: Metrics, details: LoopsFile) -> dict[str, Any] | None:
    """``counts`` of loops, ``reasons`` of those that are missing, and a ``table`` of the accepted and the rejected."""
    found = metrics.loops
    if found.absent:
        return None
    stages = {name: number(found, name) for name in ("candidates", "verified", "accepted")}
    groups = (("accepted", details.accepted), ("rejected", found.rejected))
    rows = [(str(loop.from_), str(loop.to), verdict, loop.reason) for verdict, group in groups for loop in group or ()]
    left_out = details.rejected_left_out
    where = LOOPS + (f", without {left_out} rejected ones of fewest inliers" if left_out else "")
    return {
        "counts": ", ".join(f"{cell.text} {stage}" for stage, cell in stages.items()),
        "reasons": notes_on(cell.tooltip for cell in stages.values()),
        "table": _first_of(("from frame", "to frame", "verdict", "reason"), rows, where),
    }


def tracking(metrics: Metrics) -> dict[str, Any] | None:
    """``counts`` of keyframes and maps, and a ``table`` of what became of them; None without keyframes."""
    found = metrics.tracking
    if found.absent:
        return None
    rows = [
        ["" if value is None else str(value) for value in (event.frame, event.event, event.other, event.support)]
        for event in found.events or ()
    ]
    return {
        "counts": f"{number(found, 'keyframes').text} keyframes, {number(found, 'maps').text} maps",
        "table": _first_of(("frame", "event", "at the place of frame", "points or loops"), rows, METRICS),
    }


def graph(metrics: Metrics) -> dict[str, Any] | None:
    """``nodes`` and ``factors`` of the pose graph, and the ``reasons`` why its noise is not covered."""
    found = metrics.graph
    if found.absent:
        return None
    reasons = notes_on([f"coverage: {found.coverage.absent}"]) if found.coverage.absent else []
    return {"nodes": number(found, "nodes").text, "factors": number(found, "factors").text, "reasons": reasons}


def timing(metrics: Metrics) -> Table | None:
    """Seconds by stage, the longest first; None where nothing was timed."""
    stages = metrics.timing.stages
    if not stages:
        return None
    timed = sum(stages.values())
    total = max(metrics.timing.seconds_total or 0.0, timed, 1e-9)
    stages = stages | {"between stages": total - timed}
    longest = max(*stages.values(), 1e-9)
    rows = [
        [Cell(name), Cell(f"{seconds:.1f} s"), Cell(f"{100 * seconds / total:.0f} %"), _bar(seconds / longest)]
        for name, seconds in sorted(stages.items(), key=lambda item: -item[1])
    ]
    memory, processor = (number(metrics.timing, name).text for name in ("peak_rss_mb", "cpu_seconds"))
    words = f"{total:.1f} s in all, {processor} s of processor time, at most {memory} MiB of memory."
    return Table(("stage", "time", "share", ""), rows, notes=[words])


def _missing_errors(metrics: Metrics) -> list[str]:
    """What of the errors is missing, by reason."""
    missing: dict[str, list[str]] = {}
    for column in COLUMNS:
        for name, errors in metrics.evaluated_errors().items():
            value, reason = errors.at(column.path)
            if value is None:
                missing.setdefault(reason, []).append(f"{column.name} of {name}")
    for name, errors in metrics.all_errors().items():
        if errors.absent:
            missing.setdefault(errors.absent, []).append(f"{name} trajectory")
    return [f"{', '.join(what) if len(what) <= 4 else 'others'}: {why}" for why, what in missing.items()]


def _texts(rows: Iterable[Sequence[str]]) -> list[list[Cell]]:
    return [[Cell(text) for text in row] for row in rows]


def _first_of(head: Sequence[str], rows: Sequence[Sequence[str]], where: str) -> Table | None:
    """The first rows, with a note on the file ``where`` all of them are; None without any."""
    more = [f"{len(rows) - MOST_LOOPS} more in {where}."] if len(rows) > MOST_LOOPS else []
    return Table(head, _texts(rows[:MOST_LOOPS]), "words", more) if rows else None


def _bar(ratio: float) -> Cell:
    return Cell("", style="track", bar=100.0 * min(max(ratio, 0.0), 1.0))


def notes_on(reasons: Iterable[str]) -> list[str]:
    """One line with the reasons of missing numbers, each once; none where nothing is missing."""
    distinct = [reason for reason in dict.fromkeys(reasons) if reason]
    return [f"{DASH}  {'; '.join(distinct)}."] if distinct else []


def _depth_source(metrics: Metrics) -> str:
    name = metrics.provenance.depth_source
    if name is None:
        return f"{DASH} ({metrics.provenance.why('depth_source')})"
    sha256 = metrics.provenance.depth_sha256
    return "by these weights" if name == "network" else f"{name}, sha256 {str(sha256)[:16]}"


def _stretches(found: list[Stretch] | None) -> str:
    """Consecutive frames, with the reason of the first."""
    return _shortened([f"{each.first} to {each.last}: {each.reason}" for each in found or ()])


def _shortened(names: Sequence[str], most: int = 12) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
