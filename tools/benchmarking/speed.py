"""Time, memory and stages of two checkouts, measured in turn."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median

from erfsfm.common.processes import slam_process
from erfsfm.common.table import Table
from slam.runtime.files import METRICS

Cost = dict[str, float]  # of a run, by column
Costs = dict[str, dict[str, Cost]]  # medians by drive and checkout
COLUMNS = ("CPU ms / frame", "ms / frame", "peak RSS (MiB)")  # before the stages, ms a frame each


def in_turn(
    checkouts: Mapping[str, Path], drives: Mapping[str, Sequence[str]], pairs: int, output: Path
) -> Costs:
    """The costs of each drive, arguments of ``erfsfm-slam run``, by each of two checkouts; every run is a new one.

    Raises:
        SystemExit: a run failed.
    """
    costs: Costs = {}
    for row, (drive, arguments) in enumerate(drives.items()):
        runs: dict[str, list[Cost]] = {commit: [] for commit in checkouts}
        for pair in range(pairs):
            for column, (commit, checkout) in enumerate(checkouts.items()):
                runs[commit].append(_cost(checkout, arguments, output / f"{row}-{pair}-{column}"))
                print(
                    f"{drive}, {commit}: {runs[commit][-1][COLUMNS[0]]:.1f} ms a frame",
                    file=sys.stderr,
                )
        costs[drive] = {}
        for commit, found in runs.items():
            costs[drive][commit] = {
                key: median(each.get(key, 0.0) for each in found) for key in found[0]
            }
    return costs


def tables(costs: Costs) -> str:
    """Costs and their ratios, then the stages, in Markdown."""
    before, after = next(iter(costs.values()))
    known: dict[str, None] = {}
    for pair in costs.values():
        for cost in pair.values():
            known |= dict.fromkeys(cost)
    stages = list(known)[len(COLUMNS) :]
    rows = []
    by_stage = []
    for drive, pair in costs.items():
        row = [drive]
        for key in COLUMNS:
            old, new = (cost[key] for cost in pair.values())
            row.append(f"{old:.0f}, {new:.0f}: **{new / old:.2f}**")
        rows.append(row)
        for commit, cost in pair.items():
            times = [f"{cost.get(stage, 0.0):.1f}" for stage in stages]
            by_stage.append([drive, commit, *times])
    return f"""Medians of {before}, of {after}: and their ratio.

{Table(["drive", *COLUMNS], rows).markdown()}

Time that the main thread spends in or waits for each stage, ms a frame:

{Table(["drive", "commit", *stages], by_stage, names=2).markdown()}"""


def _cost(checkout: Path, arguments: Sequence[str], output: Path) -> Cost:
    log = output.with_suffix(".log")
    words, variables = ["run", *arguments, "--output", str(output)], {"PYTHONPATH": str(checkout)}
    reason = slam_process(words, checkout, log, variables=variables)
    if reason:
        raise SystemExit(f"{' '.join(arguments)} by {checkout} failed: {reason}; see {log}")
    tree = json.loads((output / METRICS).read_text(encoding="utf-8"))
    timing, ms = tree["timing"], 1e3 / tree["sequence"]["frames"]
    measured = (
        ms * timing["cpu_seconds"],
        1e3 / timing["frames_per_second"],
        timing["peak_rss_mb"],
    )
    return dict(zip(COLUMNS, measured)) | {
        stage: ms * seconds for stage, seconds in timing["stages"].items()
    }
