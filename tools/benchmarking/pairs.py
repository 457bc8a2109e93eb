"""Two checkouts in turn on the same drives: processor time, frames a second, the busiest thread, memory, stages."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from erfsfm.common.table import Table
from slam.runtime.run_files import METRICS

_LOOK_S = 0.2
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Drive:
    """A row of the table: arguments of ``erfsfm-slam run``."""

    name: str
    arguments: tuple[str, ...]


@dataclass(frozen=True)
class Cost:
    """Of a run, ms a frame: processor time, time and stages; that of its busiest thread with start; peak memory."""

    cpu_ms: float
    ms: float
    busiest_ms: float
    peak_mib: float
    stages_ms: Mapping[str, float]


def in_turn(checkouts: Sequence[Path], drives: Sequence[Drive], pairs: int, output: Path) -> list[list[Cost]]:
    """The median cost of each drive by each checkout, ``[drive][checkout]``, each run a new one.

    Raises:
        SystemExit: a run failed.
    """
    costs = []
    for row, drive in enumerate(drives):
        runs: list[list[Cost]] = [[] for _ in checkouts]
        for pair in range(pairs):
            for column, checkout in enumerate(checkouts):
                runs[column].append(_cost(checkout, drive, output / f"{row}-{pair}-{column}"))
                print(f"{drive.name}, {checkout.name}: {runs[column][-1].cpu_ms:.1f} ms a frame", file=sys.stderr)
        costs.append([_median(each) for each in runs])
    return costs


def tables(checkouts: Sequence[str], drives: Sequence[Drive], costs: Sequence[Sequence[Cost]]) -> str:
    """Costs and their ratios, then the stages, in Markdown."""
    before, after = checkouts
    columns = {
        "CPU ms / frame": "cpu_ms",
        "ms / frame": "ms",
        "CPU ms / frame of the busiest thread": "busiest_ms",
        "peak RSS (MiB)": "peak_mib",
    }
    rows = []
    for drive, (old, new) in zip(drives, costs, strict=True):
        pairs = [(getattr(old, name), getattr(new, name)) for name in columns.values()]
        rows.append([drive.name, *(f"{a:.0f}, {b:.0f}: **{b / a:.2f}**" for a, b in pairs)])
    stages = list(dict.fromkeys(stage for pair in costs for cost in pair for stage in cost.stages_ms))
    by_stage = [
        [drive.name, checkout, *(f"{cost.stages_ms.get(stage, 0.0):.1f}" for stage in stages)]
        for drive, pair in zip(drives, costs, strict=True)
        for checkout, cost in zip(checkouts, pair, strict=True)
    ]
    return f"""Medians of {before}, of {after}: and their ratio.

{Table(["drive", *columns], rows).markdown()}

Time that the main thread spends in or waits for each stage, ms a frame:

{Table(["drive", "commit", *stages], by_stage, names=2).markdown()}"""


def _cost(checkout: Path, drive: Drive, output: Path) -> Cost:
    words = [sys.executable, "-P", "-m", "slam", "run", *drive.arguments, "--output", str(output)]
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    log = output.with_suffix(".log")
    busiest: dict[int, float] = {}
    with log.open("w") as file:
        process = subprocess.Popen(words, cwd=checkout, env=environment, stdout=file, stderr=subprocess.STDOUT)
        while process.poll() is None:
            busiest |= _thread_seconds(process.pid)
            time.sleep(_LOOK_S)
    if process.returncode:
        raise SystemExit(f"{drive.name} by {checkout} failed; see {log}")
    tree: dict[str, Any] = json.loads((output / METRICS).read_text(encoding="utf-8"))
    timing, ms = tree["timing"], 1e3 / tree["sequence"]["frames"]
    return Cost(
        ms * timing["cpu_seconds"],
        1e3 / timing["frames_per_second"],
        ms * max(busiest.values(), default=float("nan")),
        timing["peak_rss_mb"],
        {stage: ms * seconds for stage, seconds in timing["stages"].items()},
    )


def _thread_seconds(pid: int) -> dict[int, float]:
    """Processor time of each thread so far; nothing where the system does not tell (all but Linux)."""
    seconds = {}
    for path in Path(f"/proc/{pid}/task").glob("*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # the thread has ended
            continue
        seconds[int(path.parent.name)] = (int(fields[11]) + int(fields[12])) / _TICKS
    return seconds


def _median(costs: Sequence[Cost]) -> Cost:
    stages = {stage: median(c.stages_ms.get(stage, 0.0) for c in costs) for stage in costs[0].stages_ms}
    names = "cpu_ms", "ms", "busiest_ms", "peak_mib"
    cpu, ms, busiest, peak = (median(getattr(c, name) for c in costs) for name in names)
    return Cost(cpu, ms, busiest, peak, stages)
