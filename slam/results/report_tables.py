"""The tables of a report: ``metrics.json`` in, HTML out; every missing number shows its reason."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from slam.results import report_page as page
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
from slam.results.folder import TRAJECTORIES
from slam.results.report_page import Cell

Metrics = Mapping[str, Any]

ALIGNMENTS = ("none", "first", "scale", "6dof", "7dof")
MOST_LOOPS = 40
_PER_ALIGNMENT = (
    ("ate_rmse_m", "ATE RMSE, m", 3),
    ("t_rel_percent", "t_rel, %", 2),
    ("r_rel_deg_per_100m", "r_rel, deg / 100 m", 3),
    ("rpe_trans_m", "RPE, m", 4),
    ("rpe_rot_deg", "RPE, deg", 4),
    ("scale", "scale", 4),
)
_MAP_NAMES = {"accuracy_median_m": "accuracy, median (m)"}


def number(metrics: Metrics, *path: str, decimals: int = 0) -> Cell:
    """A number of the metrics as a cell; a dash with its reason as a tooltip where there is none."""
    value, reason = lookup(metrics, *path)
    words = f"{value:,}" if isinstance(value, int) else written(value, decimals)
    return Cell(words, reason, "missing" if reason else "")


def key_numbers(metrics: Metrics) -> str:
    """The numbers to see first."""
    best = ("trajectories", "optimised")
    return page.cards(
        [
            ("Position error", number(metrics, *best, "align", "7dof", "ate_rmse_m", decimals=2), "m, 7 dof"),
            ("Drift, t_rel", number(metrics, *best, *T_REL.path, decimals=2), "%"),
            ("Path", number(metrics, "sequence", "length_m"), "m"),
            ("Frames", number(metrics, "sequence", "frames"), ""),
            ("Speed", number(metrics, "timing", "frames_per_second", decimals=1), "frames/s"),
            ("Loops accepted", number(metrics, "loops", "accepted"), ""),
            ("Map triangles", number(metrics, "map", "triangles"), ""),
        ]
    )


def what_ran(metrics: Metrics) -> str:
    """Sequence, weights, scale and command; a run that failed early has less to say."""

    def say(*path: str, decimals: int = 1, unit: str = "") -> str:
        value, reason = lookup(metrics, *path)
        return f"{MISSING} ({reason})" if value is None else f"{written(value, decimals)}{unit}"

    seen, _ = lookup(metrics, "provenance", "trained_on")
    leak, _ = lookup(metrics, "provenance", "leak")
    sha256 = say("provenance", "weights_sha256")
    rows = [
        ("Sequence", f"{say('sequence', 'name')}, {say('sequence', 'frames')} frames"),
        ("Bridged frames", _bridged(metrics)),
        ("True length", say("sequence", "length_m", unit=" m")),
        ("Frame rate", say("sequence", "fps", unit=" frames/s")),
        ("Scale", f"mode {say('scale', 'mode')}, value {say('scale', 'value', decimals=4)}"),
        ("Speed", say("timing", "frames_per_second", unit=" frames/s over the whole run")),
        ("Weights", f"{say('provenance', 'weights')}, sha256 {sha256 if MISSING in sha256 else sha256[:16]}"),
        ("Licence of the weights", say("provenance", "weights_licence")),
        ("Trained on", _shortened([str(name) for name in seen]) if seen else MISSING),
        ("Leak", {True: "yes: trained on this sequence", False: "none known"}.get(leak, MISSING)),
        ("Command", say("provenance", "command")),
        ("Seed, device", f"{say('provenance', 'seed')}, {say('provenance', 'device')}"),
        ("Version, commit", f"{say('provenance', 'version')}, {say('provenance', 'commit')}"),
    ]
    told = [row for row in rows if NOT_RECORDED not in row[1]] if failure(metrics) else rows
    return page.table((), told, "words")


def errors(metrics: Metrics) -> str:
    """Every trajectory against the truth, a column each; empty where nothing was evaluated."""
    known = [name for name in TRAJECTORIES if lookup(metrics, "trajectories", name)[0] is not None]
    if not known:
        return ""
    places = [("trajectories", name, *statistic.path) for statistic in STATISTICS for name in known]
    if all(lookup(metrics, *place)[0] is None for place in places):
        return page.text(f"No errors: {lookup(metrics, *places[0])[1]}.", "soft")
    missing: dict[str, list[str]] = {}

    def row(statistic: ErrorColumn) -> list[Cell | str]:
        values = [lookup(metrics, "trajectories", name, *statistic.path) for name in known]
        for name, (_, why) in zip(known, values):
            missing.setdefault(why, []).append(f"{statistic.name} of {name}")
        cells = _cells(values, statistic.decimals, mark_best=statistic is not EVO_DIFFERENCE)
        if statistic.path[0] == "snippet5":
            spread = (*statistic.path[:-1], statistic.path[-1].replace("_mean", "_std"))
            stds = (lookup(metrics, "trajectories", name, *spread)[0] for name in known)
            cells = [
                cell if std is None else replace(cell, text=f"{cell.text} ± {written(std, statistic.decimals)}")
                for cell, std in zip(cells, stds)
            ]
        return [statistic.name, *cells]

    rows: list[page.Row | str] = [
        "Snippets of five frames, each with its own scale; ATE is norm / 5",
        *(row(statistic) for statistic in (SNIPPET_ATE, SNIPPET_RE)),
        "Whole trajectory: position error in metres, by alignment",
        *(row(statistic) for statistic in ALIGNED_ATE),
        "KITTI segments of 100 to 800 m",
        *(row(statistic) for statistic in (T_REL, R_REL)),
        "Cross-check",
        row(EVO_DIFFERENCE),
    ]
    for name in TRAJECTORIES:
        missing.setdefault(lookup(metrics, "trajectories", name)[1], []).append(f"{name} trajectory")
    reasons = [f"{', '.join(what) if len(what) <= 4 else 'others'}: {why}" for why, what in missing.items() if why]
    return page.table(["", *known], rows) + page.text("Bold: the best of a row.", "note") + _notes(reasons)


def alignments(metrics: Metrics) -> str:
    """Every statistic of every trajectory under every alignment; empty where nothing was evaluated."""
    rows: list[page.Row | str] = []
    for name in TRAJECTORIES:
        place = ("trajectories", name, "align")
        if lookup(metrics, *place)[0] is None:
            continue
        rows.append(name)
        for how in ALIGNMENTS:
            cells = [number(metrics, *place, how, key, decimals=decimals) for key, _, decimals in _PER_ALIGNMENT]
            rows.append([how, *cells])
    return page.table(["alignment", *(label for _, label, _ in _PER_ALIGNMENT)], rows) if rows else ""


def map_numbers(metrics: Metrics) -> str:
    """Size and quality of the map."""
    numbers, reason = lookup(metrics, "map")
    if numbers is None:
        return page.text(f"No map: {reason}.", "soft")
    keys = [key for key in numbers if not key.endswith("_reason")]
    names = [_MAP_NAMES.get(key, key.replace("_", " ")) for key in keys]
    cells = [number(numbers, key, decimals=3) for key in keys]
    missing = [f"{name}: {cell.tooltip}" for name, cell in zip(names, cells) if cell.tooltip]
    return page.table(["", *names], [["map", *cells]]) + _notes(missing)


def loops(metrics: Metrics, loops_file: Path) -> str:
    """How many loops were found; the accepted ones of ``loops.json`` and the rejected ones, with the reason."""
    tree, reason = lookup(metrics, "loops")
    if tree is None:
        return page.text(f"No loops: {reason}.", "soft")
    stages = ("candidates", "verified", "accepted")
    counts = ", ".join(f"{number(tree, stage).text} {stage}" for stage in stages)
    pieces = [page.text(f"{counts}."), _notes(lookup(tree, stage)[1] for stage in stages)]
    groups = (("accepted", _details(loops_file, "accepted")), ("rejected", tree.get("rejected") or []))
    rows = [
        (str(loop.get("from")), str(loop.get("to")), verdict, str(loop.get("reason") or ""))
        for verdict, entries in groups
        for loop in entries
        if isinstance(loop, Mapping)
    ]
    if rows:
        pieces.append(page.table(("from frame", "to frame", "verdict", "reason"), rows[:MOST_LOOPS], "words"))
    if len(rows) > MOST_LOOPS:
        pieces.append(page.text(f"{len(rows) - MOST_LOOPS} more in {loops_file.name}.", "note"))
    return "".join(pieces)


def graph(metrics: Metrics) -> str:
    """Size of the pose graph, and whether its noise means what it says; empty without a graph."""
    if lookup(metrics, "graph")[0] is None:
        return ""
    nodes, factors = (number(metrics, "graph", key).text for key in ("nodes", "factors"))
    size = page.text(f"{nodes} poses and {factors} factors.")
    coverage, reason = lookup(metrics, "graph", "coverage")
    if coverage is None:
        return size + _notes([f"coverage: {reason}"])
    rows: list[page.Row | str] = []
    for level in ("50", "90", "95"):
        share, why = lookup(coverage, level)
        shown = MISSING if share is None else f"{100 * share:.0f} %"
        rows.append([f"inside the {level} % quantile", Cell(shown, why, "missing" if why else "")])
    words = (
        "Share of factors whose error at the truth lies inside a quantile of their stated noise. A share below its "
        "quantile means sigmas that are too small, one above it sigmas that are too large."
    )
    return size + page.table(("factors", "share"), rows, "words") + page.text(words, "note")


def timing(metrics: Metrics) -> str:
    """Seconds by stage, the longest first; empty where nothing was timed."""
    stages, _ = lookup(metrics, "timing", "stages")
    if not stages:
        return ""
    total = max(float(lookup(metrics, "timing", "seconds_total")[0] or 0.0), sum(stages.values()), 1e-9)
    longest = max(*stages.values(), 1e-9)
    rows = [
        (name, f"{seconds:.1f} s", f"{100 * seconds / total:.0f} %", seconds / longest)
        for name, seconds in sorted(stages.items(), key=lambda item: -item[1])
    ]
    memory, processor = (number(metrics, "timing", key).text for key in ("peak_rss_mb", "cpu_seconds"))
    words = f"{total:.1f} s in all, {processor} s of processor time, at most {memory} MiB of memory."
    return page.bars(("stage", "time", "share"), rows) + page.text(words, "note")


def _cells(values: Sequence[tuple[Any, str]], decimals: int, mark_best: bool) -> list[Cell]:
    """Cells of a row of errors; the smallest of several is marked."""
    numbers = [value for value, _ in values if value is not None]
    least = min(numbers) if mark_best and len(set(numbers)) > 1 else None
    cells = []
    for value, reason in values:
        style = "missing" if value is None else "best" if value == least else ""
        cells.append(Cell(written(value, decimals), reason, style))
    return cells


def _notes(reasons: Iterable[str]) -> str:
    """Why numbers are missing, each reason once, readable on paper too."""
    distinct = [reason for reason in dict.fromkeys(reasons) if reason]
    return page.text(f"{MISSING}  {'; '.join(distinct)}.", "note") if distinct else ""


def _details(loops_file: Path, verdict: str) -> list[Any]:
    """One list of ``loops.json``; empty where the file is missing or damaged: the report goes on."""
    try:
        tree = json.loads(loops_file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    entries = tree.get(verdict) if isinstance(tree, dict) else None
    return entries if isinstance(entries, list) else []


def _bridged(metrics: Metrics) -> str:
    """Frames that measured nothing, with the reason of each run of them."""
    found, _ = lookup(metrics, "sequence", "bridged")
    gaps = [f"{gap['first']} to {gap['last']}: {gap['reason']}" for gap in found or ()]
    return _shortened(gaps) if gaps else "none"


def _shortened(names: Sequence[str], most: int = 12) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
