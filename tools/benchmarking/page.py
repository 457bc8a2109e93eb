"""Tables of results in Markdown, the picture of all drives, and the page that holds them."""

from __future__ import annotations

import math
import os
import platform
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from benchmarking import handheld
from benchmarking import metrics as m
from benchmarking.definitions import MetricDefinition
from benchmarking.runs import EVERYTHING, FALSE_DEG, FALSE_M, JobResult, revision
from benchmarking.tables import (
    Cell,
    Label,
    configuration,
    drive,
    grouped,
    kind,
    mean,
    middle_and_extreme,
    over_seeds,
    spread,
    table,
    values,
    weights,
)
from make_figures import draw_trajectories, trajectories_of
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from erfsfm.common.files import write_atomically
from erfsfm.common.table import DASH
from slam.results.folder import RunFolder

PICTURE = "images/trajectories.png"  # beside the page
SIDE_IN = 1.9
DPI = 90
COLOURS = 48  # a third of the bytes of a full palette, without a visible difference
PAGE = """# Benchmarks

`tools/benchmark.py` writes this page; `--help` says how. Every section gives its command, its commit and its seeds.

- A seed is `--seed` of the run. It seeds the draws of RANSAC and nothing else: images, worlds and weights are the same
  for every seed. A standard deviation over seeds is therefore the spread of these draws, not of training or data.
- Position errors (ATE RMSE) are in metres: mean, and ± standard deviation if there are several seeds.
- *scale* is the factor by which the optimised trajectory must be multiplied to fit the truth best.
"""


_COUNTS: dict[str, Cell] = {
    "runs": lambda group: str(len(group)),
    "failed": lambda group: str(sum(bool(o.reason) for o in group)),
}


def error_tables(results: Sequence[JobResult]) -> str:
    """One row for each kind of drive, then one for each sequence and weights."""
    definitions = (
        m.FRAMES,
        m.LENGTH,
        *m.ERRORS,
        m.PERCENT,
        m.PERCENT_6,
        m.OF_NETWORK,
        m.R_REL,
        m.SCALE,
    )
    definitions += (m.LOOPS, m.FALSE_LOOPS, m.COVERAGE, m.RATE, m.MEMORY)
    columns = {q.title: over_seeds(q) for q in definitions}
    return f"""Every kind of drive: median and, in brackets, the worst run. ATE is that of the optimised
trajectory, 7-dof; a loop is false that is more than {FALSE_M:g} m or {FALSE_DEG:g} degrees off the truth.

{summary_table(results)}

Every drive:

{table({"sequence": drive, "weights": weights}, columns, results)}{notes(results, definitions)}"""


def maps_tables(results: Sequence[JobResult]) -> str:
    """Errors of the map with everything on and with one part turned off; sizes and cost."""
    rows = {"sequence": drive, "weights": weights, "configuration": configuration}
    whole = [o for o in results if o.job.configuration == EVERYTHING]
    costs = (*m.MAP_SIZES, m.FUSION, m.MESH, m.MEMORY)
    sizes = table(
        {"sequence": drive, "weights": weights}, {q.title: over_seeds(q) for q in costs}, whole
    )
    return f"""Errors of the map after one rigid motion, by the best truth of each drive
([metrics](metrics.md#error-of-the-map)). *Double walls* is the share of the mesh's area with a parallel surface 0.3 to
2 m before it.

{table(rows, {q.title: over_seeds(q) for q in m.MAP_ERRORS}, results)}

Sizes and cost:

{sizes}{notes(results, (*m.MAP_ERRORS, *costs))}"""


def handheld_tables(results: Sequence[JobResult]) -> str:
    """One row for each kind of recording beside published marks, then one for each recording."""
    columns = {q.title: over_seeds(q) for q in (m.FRAMES, *handheld.DEFINITIONS, m.CPU)}
    rows = {"recording": drive, "weights": weights}
    return f"""ATE is that of the optimised trajectory, 7-dof, over all frames with a known true pose. *Losses* are
stretches of frames without a pose in a map of keyframes. They end with a new map, or with the old one found again. A
frame is *located* if it has a pose in a map. The first table has medians and, in brackets, the worst.

{handheld_summary(results)}

Every recording:

{table(rows, columns, results)}{notes(results, (handheld.ATE, handheld.LOSSES, handheld.FIRST_MAP))}"""


def handheld_summary(results: Sequence[JobResult]) -> str:
    """One row for each kind of recording and weights."""
    columns: dict[str, Cell] = {
        **_COUNTS,
        "mean ATE 7-dof (m)": lambda group: mean(
            values(group, handheld.ATE), handheld.ATE.decimals
        ),
        "ATE 7-dof, % of path: median (worst)": middle_and_extreme(handheld.PERCENT, max),
        "losses in all": lambda group: (
            f"{sum(lost):.0f}" if (lost := values(group, handheld.LOSSES)) else DASH
        ),
        "frames before the first map": middle_and_extreme(handheld.FIRST_MAP, max),
        "before a new map": middle_and_extreme(handheld.NEW_MAP, max),
        "share of frames located": middle_and_extreme(handheld.LOCATED, min),
        "CPU ms / frame": middle_and_extreme(m.CPU, max),
    }
    rows: dict[str, Label] = {
        "recordings": kind,
        "weights": weights,
        "published": lambda o: handheld.MARKS.get(kind(o), DASH),
    }
    return table(rows, columns, results)


TABLES: dict[str, Callable[[Sequence[JobResult]], str]] = {
    "accuracy": error_tables,
    "full-size": error_tables,
    "maps": maps_tables,
    "handheld": handheld_tables,
}


def notes(results: Sequence[JobResult], definitions: Iterable[MetricDefinition]) -> str:
    """Leaks, reasons of missing numbers, and failed runs, a line each."""
    lines: dict[str, None] = {}
    for o in results:
        if o.reason:
            continue
        if o.metrics.provenance.leak is True:
            lines[
                f"LEAK: weights {o.job.weights} saw frames of {o.job.drive.name} in training."
            ] = None
        for definition in definitions:
            if definition.value(o) is None:
                lines[f"{DASH} {definition.title}, {o.job.drive.name}: not known."] = None
    lines |= {f"Failed: {o.job.title}: {o.reason}": None for o in results if o.reason}
    return "\n" + "".join(f"\n- {line}" for line in lines)


def section(mode: str, command: str, results: Sequence[JobResult], at_a_time: str) -> str:
    """A section of the page: command, commit and seeds, then its tables."""
    seeds = ", ".join(dict.fromkeys(str(o.job.seed) for o in results))
    failed = sum(bool(o.reason) for o in results)
    picture = (
        f"\n\n![every drive from above]({PICTURE})"
        if mode == "accuracy" and drawable(results)
        else ""
    )
    return f"""## {mode.capitalize()}

    {command}

Commit {revision()}; seeds {seeds}; {len(results)} runs, {failed} failed; {at_a_time} at a time on
{os.cpu_count()} {platform.machine()} cores.

{TABLES[mode](results)}{picture}
"""


def speed_section(command: str, tables: str) -> str:
    """The section of two checkouts in turn."""
    return f"""## Speed

    {command}

On {os.cpu_count()} {platform.machine()} cores, load {os.getloadavg()[0]:.1f} at the end.

{tables}
"""


def with_section(page: str, new: str) -> str:
    """The page with a section in place of the one of the same title; those that no mode writes come last."""
    _, *old = re.split(r"(?m)^(?=## )", page)
    sections = {text.splitlines()[0]: text.strip() + "\n" for text in [*old, new]}
    order = [f"## {mode.capitalize()}" for mode in (*TABLES, "speed")]
    place = {title: number for number, title in enumerate(order)}
    titles = sorted(sections, key=lambda title: place.get(title, len(order)))
    return "\n".join([PAGE, *(sections[title] for title in titles)])


def summary_table(results: Sequence[JobResult]) -> str:
    """One row for each kind of drive and weights; every number is over all of its runs."""
    columns: dict[str, Cell] = {
        **_COUNTS,
        "ATE 7-dof, % of path: median (worst)": middle_and_extreme(m.PERCENT, max),
        "ATE 6-dof, % of path": middle_and_extreme(m.PERCENT_6, max),
        "the network's": middle_and_extreme(m.NETWORK_PERCENT, max),
        "over the network's": middle_and_extreme(m.OF_NETWORK, max),
        "over the clean drive's": against_clean(results),
        "drives with a true loop": lambda group: (
            f"{sum(n > 0 for n in values(group, m.TRUE_LOOPS))} of {len(group)}"
        ),
        "false loops": lambda group: f"{sum(values(group, m.FALSE_LOOPS)):.0f}",
        "frames / s": middle_and_extreme(m.RATE, min),
        "CPU ms / frame": middle_and_extreme(m.CPU, max),
        "peak RSS (MiB)": middle_and_extreme(m.MEMORY, max),
    }
    return table({"drives": kind, "weights": weights}, columns, results)


def against_clean(results: Sequence[JobResult]) -> Cell:
    """Optimised 7-dof errors over those of the same drives without hazards."""

    def key(name: str, o: JobResult) -> tuple[str, str, str, int]:
        return name, o.job.weights, o.job.configuration, o.job.seed

    by_run = {key(o.job.drive.name, o): o for o in results}

    def cell(group: Sequence[JobResult]) -> str:
        ratios = []
        for o in group:
            twin = by_run.get(key(o.job.drive.clean, o))
            ate = m.ATE_7.value(o)
            clean = None if twin is None else m.ATE_7.value(twin)
            if ate is not None and clean is not None and clean > 0:
                ratios.append(ate / clean)
        return spread(ratios, 2, max)

    return cell


def drawable(results: Sequence[JobResult]) -> list[JobResult]:
    """The first run of every drive that ended well."""
    return [runs[0] for runs in grouped([o for o in results if not o.reason], drive).values()]


def draw(results: Sequence[JobResult], path: Path) -> None:
    """Network, odometry and optimised trajectory over the truth, a panel a drive."""
    chosen = drawable(results)
    columns = math.ceil(math.sqrt(1.6 * len(chosen)))
    rows = math.ceil(len(chosen) / columns)
    figure = Figure(
        figsize=(columns * SIDE_IN, rows * SIDE_IN + 0.5), dpi=DPI, layout="constrained"
    )
    panels = figure.subfigures(rows, columns, squeeze=False).flat
    for o, panel in zip(chosen, panels):
        axes = draw_trajectories(panel, trajectories_of(RunFolder.open(o.job.place)), "")
        legend = axes.get_legend()
        if legend is not None:
            legend.remove()
        axes.set(xlabel="", ylabel="")
        axes.set_title(drive(o), fontsize=8)
        axes.tick_params(labelsize=6)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=min(columns, len(labels)), fontsize=9
    )
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    light = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).quantize(COLOURS)
    write_atomically(path, lambda file: light.save(file, format="png", optimize=True))
