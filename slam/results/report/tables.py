"""The tables of a report, from ``metrics.json``; every missing number shows its reason."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from slam.results.comparison import (
    ALIGNED_ATE,
    EVO_DIFFERENCE,
    MISSING,
    NOT_RECORDED,
    R_REL,
    SNIPPET_ATE,
    SNIPPET_RE,
    STATISTICS,
    T_REL,
    ErrorColumn,
    failure,
    lookup,
    written,
)
from slam.results.schema import LoopsFile
from slam.runtime.errors import RunError
from slam.runtime.run_files import TRAJECTORIES
from slam.runtime.storage.json_file import read_json

Metrics = Mapping[str, Any]


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


ALIGNMENTS = ("none", "first", "scale", "6dof", "7dof")
MOST_LOOPS = 40
_STAGES = {"journal": "journal, from which run --continue goes on"}
_PER_ALIGNMENT = (
    ("ate_rmse_m", "ATE RMSE, m", 3),
    ("t_rel_percent", "t_rel, %", 2),
    ("r_rel_deg_per_100m", "r_rel, deg / 100 m", 3),
    ("rpe_trans_m", "RPE, m", 4),
    ("rpe_rot_deg", "RPE, deg", 4),
    ("scale", "scale", 4),
)


def number(metrics: Metrics, *path: str, decimals: int = 0) -> Cell:
    """A number of the metrics as a cell; a dash with its reason as a tooltip where there is none."""
    value, reason = lookup(metrics, *path)
    words = f"{value:,}" if isinstance(value, int) else written(value, decimals)
    return Cell(words, reason, "missing" if reason else "")


def key_numbers(metrics: Metrics) -> list[tuple[str, Cell, str]]:
    """The key numbers that there are: name, value and unit of each."""
    best = ("trajectories", "optimised")
    wanted = [
        ("Position error", number(metrics, *best, "align", "7dof", "ate_rmse_m", decimals=2), "m, 7 dof"),
        ("Drift, t_rel", number(metrics, *best, *T_REL.path, decimals=2), "%"),
        ("Path", number(metrics, "sequence", "length_m"), "m"),
        ("Frames", number(metrics, "sequence", "frames"), ""),
        ("Speed", number(metrics, "timing", "frames_per_second", decimals=1), "frames/s"),
        ("Loops accepted", number(metrics, "loops", "accepted"), ""),
        ("Map triangles", number(metrics, "map", "triangles"), ""),
    ]
    return [(name, cell, unit) for name, cell, unit in wanted if cell.style != "missing"]


def what_ran(metrics: Metrics) -> Table:
    """Sequence, weights, scale and command; a run that failed early has fewer rows."""

    def text(*path: str, decimals: int = 1, unit: str = "") -> str:
        value, reason = lookup(metrics, *path)
        return f"{MISSING} ({reason})" if value is None else f"{written(value, decimals)}{unit}"

    seen, _ = lookup(metrics, "provenance", "trained_on")
    leak, _ = lookup(metrics, "provenance", "leak")
    sha256, noise = text("provenance", "weights_sha256"), text("provenance", "noise_sha256")
    rows = [
        ("Sequence", f"{text('sequence', 'name')}, {text('sequence', 'frames')} frames"),
        ("Interpolated frames", _frames(metrics, "bridged") or "none"),
        *([("Doubled frames", doubled)] if (doubled := _frames(metrics, "doubled")) else []),
        *([("LiDAR scans left out", left_out)] if (left_out := _frames(metrics, "unreadable_scans")) else []),
        ("True length", text("sequence", "length_m", unit=" m")),
        ("Frame rate", text("sequence", "fps", unit=" frames/s")),
        ("Scale", f"mode {text('scale', 'mode')}, value {text('scale', 'value', decimals=4)}"),
        ("Speed", text("timing", "frames_per_second", unit=" frames/s over the whole run")),
        ("Weights", f"{text('provenance', 'weights')}, sha256 {sha256 if MISSING in sha256 else sha256[:16]}"),
        ("Noise of the poses", noise if MISSING in noise else f"noise.yaml, sha256 {noise[:16]}"),
        ("Depth", _depth_source(metrics)),
        ("Licence of the weights", text("provenance", "weights_licence")),
        ("Trained on", _shortened([str(name) for name in seen]) if seen else MISSING),
        ("Leak", {True: "yes: trained on this sequence", False: "none known"}.get(leak, MISSING)),
        ("Command", text("provenance", "command")),
        ("Seed, device", f"{text('provenance', 'seed')}, {text('provenance', 'device')}"),
        ("Version, commit", f"{text('provenance', 'version')}, {text('provenance', 'commit')}"),
    ]
    recorded = [row for row in rows if NOT_RECORDED not in row[1]] if failure(metrics) else rows
    return Table((), _texts(recorded), "words")


def gps(metrics: Metrics) -> Table | None:
    """Distances from the GPS track; None without one."""
    if lookup(metrics, "gps")[0] is None:
        return None
    columns = ("horizontal_rmse_m", "horizontal_median_m", "vertical_rmse_m")
    rows = [
        [Cell(name), *(number(metrics, "gps", name, column, decimals=2) for column in columns)]
        for name in ("odometry", "optimised")
    ]
    fixes, in_graph = lookup(metrics, "gps", "fixes")[0], lookup(metrics, "gps", "in_graph")[0]
    use = "factors of the pose graph: the optimised row is no independent test" if in_graph else "not in the pose graph"
    notes = [f"{fixes} fixes, {use}. Both trajectories are turned and moved onto the track, not scaled."]
    return Table(("", "horizontal RMSE, m", "horizontal median, m", "vertical RMSE, m"), rows, notes=notes)


def no_errors(metrics: Metrics) -> str:
    """Why no trajectory has an error; empty where one has, or where nothing was evaluated."""
    places = [("trajectories", name, *each.path) for each in STATISTICS for name in _evaluated(metrics)]
    if not places or any(lookup(metrics, *place)[0] is not None for place in places):
        return ""
    return lookup(metrics, *places[0])[1]


def errors(metrics: Metrics) -> Table | None:
    """Every trajectory against the truth, a column each; None where nothing was evaluated."""
    known = _evaluated(metrics)
    if not known or no_errors(metrics):
        return None

    def row(statistic: ErrorColumn) -> list[Cell]:
        values = [lookup(metrics, "trajectories", name, *statistic.path) for name in known]
        cells = _cells(values, statistic.decimals, mark_best=statistic is not EVO_DIFFERENCE)
        if statistic.path[0] == "snippet5":
            spread = (*statistic.path[:-1], statistic.path[-1].replace("_mean", "_std"))
            stds = (lookup(metrics, "trajectories", name, *spread)[0] for name in known)
            cells = [
                cell if std is None else replace(cell, text=f"{cell.text} ± {written(std, statistic.decimals)}")
                for cell, std in zip(cells, stds)
            ]
        return [Cell(statistic.name), *cells]

    rows: list[Sequence[Cell] | str] = [
        "Snippets of five frames, each with its own scale; ATE is norm / 5",
        *(row(statistic) for statistic in (SNIPPET_ATE, SNIPPET_RE)),
        "Whole trajectory: position error in metres, by alignment",
        *(row(statistic) for statistic in ALIGNED_ATE),
        "KITTI segments of 100 to 800 m",
        *(row(statistic) for statistic in (T_REL, R_REL)),
        "Cross-check",
        row(EVO_DIFFERENCE),
    ]
    return Table(["", *known], rows, notes=["Bold: the best of a row.", *notes_on(_missing_errors(metrics, known))])


def alignments(metrics: Metrics) -> Table | None:
    """Every statistic of every trajectory under every alignment; None where nothing was evaluated."""
    if no_errors(metrics):
        return None
    rows: list[Sequence[Cell] | str] = []
    for name in TRAJECTORIES:
        place = ("trajectories", name, "align")
        if lookup(metrics, *place)[0] is None:
            continue
        rows.append(name)
        for how in ALIGNMENTS:
            cells = [number(metrics, *place, how, key, decimals=decimals) for key, _, decimals in _PER_ALIGNMENT]
            rows.append([Cell(how), *cells])
    return Table(["alignment", *(label for _, label, _ in _PER_ALIGNMENT)], rows) if rows else None


def loops(metrics: Metrics, loops_file: Path) -> dict[str, Any] | None:
    """``counts`` of loops, ``reasons`` of those that are missing, and a ``table`` of the accepted and the rejected."""
    tree, _ = lookup(metrics, "loops")
    if tree is None:
        return None
    stages, details = ("candidates", "verified", "accepted"), _details(loops_file)
    groups = (("accepted", details.get("accepted", [])), ("rejected", tree.get("rejected") or []))
    rows = [
        (str(loop.get("from")), str(loop.get("to")), verdict, str(loop.get("reason") or ""))
        for verdict, entries in groups
        for loop in entries
        if isinstance(loop, Mapping)
    ]
    left_out = details.get("rejected_left_out")
    where = loops_file.name + (f", without {left_out} rejected ones of fewest inliers" if left_out else "")
    more = [f"{len(rows) - MOST_LOOPS} more in {where}."] if len(rows) > MOST_LOOPS else []
    head = ("from frame", "to frame", "verdict", "reason")
    return {
        "counts": ", ".join(f"{number(tree, stage).text} {stage}" for stage in stages),
        "reasons": notes_on(lookup(tree, stage)[1] for stage in stages),
        "table": Table(head, _texts(rows[:MOST_LOOPS]), "words", more) if rows else None,
    }


def tracking(metrics: Metrics) -> dict[str, Any] | None:
    """``counts`` of keyframes and maps, and a ``table`` of what became of them; None without keyframes."""
    tree, _ = lookup(metrics, "tracking")
    if tree is None:
        return None
    rows = [
        tuple("" if event.get(key) is None else str(event[key]) for key in ("frame", "event", "other", "support"))
        for event in tree.get("events") or []
        if isinstance(event, Mapping)
    ]
    more = [f"{len(rows) - MOST_LOOPS} more in metrics.json."] if len(rows) > MOST_LOOPS else []
    head = ("frame", "event", "at the place of frame", "points or loops")
    return {
        "counts": f"{number(tree, 'keyframes').text} keyframes, {number(tree, 'maps').text} maps",
        "table": Table(head, _texts(rows[:MOST_LOOPS]), "words", more) if rows else None,
    }


def graph(metrics: Metrics) -> dict[str, Any] | None:
    """``nodes`` and ``factors`` of the pose graph, and its ``coverage`` or the ``reasons`` why there is none."""
    if lookup(metrics, "graph")[0] is None:
        return None
    size = {key: number(metrics, "graph", key).text for key in ("nodes", "factors")}
    coverage, reason = lookup(metrics, "graph", "coverage")
    if coverage is None:
        return size | {"coverage": None, "reasons": notes_on([f"coverage: {reason}"])}
    rows = []
    for level in ("50", "90", "95"):
        ratio, why = lookup(coverage, level)
        shown = MISSING if ratio is None else f"{100 * ratio:.0f} %"
        rows.append([Cell(f"inside the {level} % quantile"), Cell(shown, why, "missing" if why else "")])
    words = (
        "Fraction of factors whose error at the truth lies inside a quantile of their stated noise. A fraction below "
        "its quantile means sigmas that are too small, one above it sigmas that are too large."
    )
    return size | {"coverage": Table(("factors", "fraction"), rows, "words", [words]), "reasons": []}


def timing(metrics: Metrics) -> Table | None:
    """Seconds by stage, the longest first; None where nothing was timed."""
    stages, _ = lookup(metrics, "timing", "stages")
    if not stages:
        return None
    timed = sum(stages.values())
    total = max(float(lookup(metrics, "timing", "seconds_total")[0] or 0.0), timed, 1e-9)
    stages = {_STAGES.get(name, name): seconds for name, seconds in stages.items()} | {"everything else": total - timed}
    longest = max(*stages.values(), 1e-9)
    rows = [
        [Cell(name), Cell(f"{seconds:.1f} s"), Cell(f"{100 * seconds / total:.0f} %"), _bar(seconds / longest)]
        for name, seconds in sorted(stages.items(), key=lambda item: -item[1])
    ]
    memory, processor = (number(metrics, "timing", key).text for key in ("peak_rss_mb", "cpu_seconds"))
    words = f"{total:.1f} s in all, {processor} s of processor time, at most {memory} MiB of memory."
    return Table(("stage", "time", "share", ""), rows, notes=[words])


def _evaluated(metrics: Metrics) -> list[str]:
    return [name for name in TRAJECTORIES if lookup(metrics, "trajectories", name)[0] is not None]


def _missing_errors(metrics: Metrics, known: Sequence[str]) -> list[str]:
    """What of the errors is missing, by reason."""
    missing: dict[str, list[str]] = {}
    for statistic in (SNIPPET_ATE, SNIPPET_RE, *ALIGNED_ATE, T_REL, R_REL, EVO_DIFFERENCE):
        for name in known:
            why = lookup(metrics, "trajectories", name, *statistic.path)[1]
            missing.setdefault(why, []).append(f"{statistic.name} of {name}")
    for name in TRAJECTORIES:
        missing.setdefault(lookup(metrics, "trajectories", name)[1], []).append(f"{name} trajectory")
    return [f"{', '.join(what) if len(what) <= 4 else 'others'}: {why}" for why, what in missing.items() if why]


def _texts(rows: Iterable[Sequence[str]]) -> list[list[Cell]]:
    return [[Cell(text) for text in row] for row in rows]


def _bar(ratio: float) -> Cell:
    return Cell("", style="track", bar=100.0 * min(max(ratio, 0.0), 1.0))


def _cells(values: Sequence[tuple[Any, str]], decimals: int, mark_best: bool) -> list[Cell]:
    """Cells of a row of errors; the smallest of several is marked."""
    numbers = [value for value, _ in values if value is not None]
    least = min(numbers) if mark_best and len(set(numbers)) > 1 else None
    cells = []
    for value, reason in values:
        style = "missing" if value is None else "best" if value == least else ""
        cells.append(Cell(written(value, decimals), reason, style))
    return cells


def notes_on(reasons: Iterable[str]) -> list[str]:
    """One line with the reasons of missing numbers, each once; none where nothing is missing."""
    distinct = [reason for reason in dict.fromkeys(reasons) if reason]
    return [f"{MISSING}  {'; '.join(distinct)}."] if distinct else []


def _details(loops_file: Path) -> dict[str, Any]:
    """``loops.json``; empty where the file is missing or damaged."""
    try:
        return read_json(loops_file, LoopsFile)
    except (OSError, RunError):
        return {}


def _depth_source(metrics: Metrics) -> str:
    name, reason = lookup(metrics, "provenance", "depth_source")
    sha256, _ = lookup(metrics, "provenance", "depth_sha256")
    if name is None:
        return f"{MISSING} ({reason})"
    return "by these weights" if name == "network" else f"{name}, sha256 {str(sha256)[:16]}"


def _frames(metrics: Metrics, name: str) -> str:
    """Consecutive frames of a list of the sequence, with the reason of the first."""
    found, _ = lookup(metrics, "sequence", name)
    return _shortened([f"{gap['first']} to {gap['last']}: {gap['reason']}" for gap in found or ()])


def _shortened(names: Sequence[str], most: int = 12) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
