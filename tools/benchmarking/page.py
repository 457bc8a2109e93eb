"""Tables of results in Markdown, and the page that holds them."""

from __future__ import annotations

import math
import os
import platform
import re
from collections.abc import Callable, Iterable, Sequence
from statistics import fmean

from benchmarking.cells import (
    Cell,
    average,
    average_among,
    configuration,
    drive,
    grouped,
    mean,
    over_seeds,
    table,
    values,
    weights,
)
from benchmarking.derived_metrics import FALSE_DEG, FALSE_M
from benchmarking.metric_definitions import (
    ATE_6,
    ATE_7,
    COMMAND,
    COVERAGE,
    CPU,
    ERRORS,
    FALSE_LOOPS,
    FRAMES,
    FUSION,
    LENGTH,
    LOAD,
    LOOPS,
    MAP_ERRORS,
    MAP_SIZES,
    MEMORY,
    MESH,
    OF_NETWORK,
    PERCENT,
    R_REL,
    RATE,
    SCALE,
    TIME,
    TRIANGLES,
    MetricDefinition,
    stages,
)
from benchmarking.picture import drawable
from benchmarking.plan import EVERYTHING, GROWTH
from benchmarking.summary import summary_table
from benchmarking.work import JobResult

from slam.results.comparison import MISSING, lookup

PICTURE = "images/trajectories.png"  # beside the page
PAGE = """# Benchmarks

`tools/benchmark.py` writes this page; `--help` says how. Every section gives its command, its commit and its seeds.

- A seed is `--seed` of the run. It seeds the draws of RANSAC and nothing else: images, worlds and weights are the same
  for every seed. A standard deviation over seeds is therefore the spread of these draws, not of training or data.
- Position errors (ATE RMSE) are in metres: mean, and ± standard deviation if there are several seeds.
- *scale* is the factor by which the optimised trajectory must be multiplied to fit the truth best.
"""


def accuracy_tables(results: Sequence[JobResult]) -> str:
    """One row for each kind of drive, then one for each sequence and weights."""
    definitions = (FRAMES, LENGTH, *ERRORS, PERCENT, OF_NETWORK, R_REL, SCALE)
    definitions += (LOOPS, FALSE_LOOPS, COVERAGE, RATE, MEMORY)
    columns = {q.title: over_seeds(q) for q in definitions}
    picture = f"\n\n![every drive from above]({PICTURE})" if drawable(results) else ""
    return f"""Every kind of drive: the median and, in brackets, the worst run. ATE is of the optimised trajectory,
7-dof. A loop is false if it is more than {FALSE_M:g} m or {FALSE_DEG:g} degrees off the truth.

{summary_table(results)}

Every drive:

{table({"sequence": drive, "weights": weights}, columns, results)}{picture}{notes(results, definitions)}"""


def ablation_tables(results: Sequence[JobResult]) -> str:
    """Ablation: errors relative to those of everything on, then the errors themselves."""
    errors, others = (ATE_7, ATE_6, R_REL), (LOOPS, COVERAGE, TRIANGLES, MEMORY)
    columns = {f"{q.title}: ratio (worst)": against_everything(q, results) for q in errors}
    columns |= {q.title: average(q) for q in others}
    drives = grouped(results, drive, weights)
    by_drive = {", ".join(label): average_among(ATE_7, group) for label, group in drives.items()}
    rows = {"configuration": configuration}
    return f"""Errors over the errors of the same sequence, weights and seed with everything on: geometric mean and, in
brackets, the worst. A ratio above 1 means that the part helps. The other columns are means.

{table(rows, columns, results)}

{ATE_7.title}, metres:

{table(rows, by_drive, results)}{notes(results, (*errors, *others))}"""


def speed_tables(results: Sequence[JobResult]) -> str:
    """Frames a second, shares of the stages, growth with the number of frames."""
    growth = [o for o in results if o.job.configuration.name == GROWTH.name]
    whole = [o for o in results if o not in growth]
    rows = {"sequence": drive, "weights": weights, "configuration": configuration}
    costs, grown = (FRAMES, RATE, TIME, CPU, COMMAND, MEMORY, LOAD), (TIME, CPU, MEMORY, LOOPS, LOAD)
    shares = {stage: stage_share(stage) for stage in stages(whole)} | {"rest": rest_share}
    by_stage = {q.title: over_seeds(q) for q in grown} | {stage: stage_ms(stage) for stage in stages(growth)}
    return f"""Everything is on. Frames a second count the time from the first image to the evaluation. The whole
command also has start and report.

{table(rows, {q.title: over_seeds(q) for q in costs}, whole)}

Share of every stage, %:

{table(rows, shares, whole)}

Growth with the number of frames, without fusion; stages in ms / frame:

{table({"sequence": drive, "weights": weights}, by_stage, growth)}{notes(results, (*costs, *grown))}"""


def maps_tables(results: Sequence[JobResult]) -> str:
    """Errors of the map with everything on and with one part turned off; sizes and cost."""
    rows = {"sequence": drive, "weights": weights, "configuration": configuration}
    whole = [o for o in results if o.job.configuration.name == EVERYTHING.name]
    costs = (*MAP_SIZES, FUSION, MESH, MEMORY)
    sizes = table({"sequence": drive, "weights": weights}, {q.title: over_seeds(q) for q in costs}, whole)
    return f"""Errors of the map after one rigid motion, by the best truth of each drive
([metrics](metrics.md#error-of-the-map)). *Double walls* is the share of the mesh's area with a parallel surface 0.3 to
2 m in front of it.

{table(rows, {q.title: over_seeds(q) for q in MAP_ERRORS}, results)}

Sizes and cost:

{sizes}{notes(results, (*MAP_ERRORS, *costs))}"""


TABLES: dict[str, Callable[[Sequence[JobResult]], str]] = {
    "accuracy": accuracy_tables,
    "ablation": ablation_tables,
    "speed": speed_tables,
    "maps": maps_tables,
}


def against_everything(definition: MetricDefinition, results: Sequence[JobResult]) -> Cell:
    """Geometric mean and worst of the ratios to the runs with everything on."""

    def key(o: JobResult) -> tuple[str, str, int]:
        return o.job.drive.name, o.job.weights, o.job.seed

    base = {key(o): values([o], definition) for o in results if o.job.configuration.name == EVERYTHING.name}

    def cell(group: Sequence[JobResult]) -> str:
        pairs = [(value, *base.get(key(o), [])) for o in group for value in values([o], definition)]
        ratios = [pair[0] / pair[1] for pair in pairs if len(pair) == 2 and min(pair) > 0]
        return f"{math.exp(fmean(map(math.log, ratios))):.2f} ({max(ratios):.2f})" if ratios else MISSING

    return cell


def stage_share(stage: str) -> Cell:
    """Per cent of the time of a run."""
    return lambda group: mean([100 * _stage(o, stage) / _seconds(o) for o in group if not o.reason], 1)


def rest_share(group: Sequence[JobResult]) -> str:
    """Per cent outside of every stage."""
    shares = [100 - 100 * sum(_stage(o, s) for s in stages([o])) / _seconds(o) for o in group if not o.reason]
    return mean(shares, 1)


def stage_ms(stage: str) -> Cell:
    """Milliseconds a frame."""
    return lambda group: mean(
        [1e3 * _stage(o, stage) / o.metrics["sequence"]["frames"] for o in group if not o.reason], 2
    )


def notes(results: Sequence[JobResult], definitions: Iterable[MetricDefinition]) -> str:
    """Leaks, reasons of missing numbers, and failed runs, a line each."""
    lines: dict[str, None] = {}
    for o in (o for o in results if not o.reason):
        if lookup(o.metrics, "provenance", "leak")[0]:
            lines[f"LEAK: weights {o.job.weights} saw frames of {o.job.drive.name} in training."] = None
        for definition in definitions:
            value, reason = lookup(o.metrics, *definition.path)
            if value is None:
                lines[f"{MISSING} {definition.title}, {o.job.drive.name}: {reason}."] = None
    lines |= {f"Failed: {o.job.title}: {o.reason}": None for o in results if o.reason}
    return "\n" + "".join(f"\n- {line}" for line in lines)


def section(mode: str, command: str, results: Sequence[JobResult], at_a_time: str) -> str:
    """A section of the page: command, commit and seeds, then its tables."""
    commits = ", ".join(dict.fromkeys(o.commit or "unknown" for o in results))
    seeds = ", ".join(dict.fromkeys(str(o.job.seed) for o in results))
    failed = sum(bool(o.reason) for o in results)
    return f"""## {mode.capitalize()}

    {command}

Commit {commits}; seeds {seeds}; {len(results)} runs, {failed} failed; {at_a_time} at a time on
{os.cpu_count()} {platform.machine()} cores.

{TABLES[mode](results)}
"""


def with_section(page: str, new: str) -> str:
    """The page with a section in place of the one of the same title, in the order of ``TABLES``; others come last."""
    _, *old = re.split(r"(?m)^(?=## )", page)
    sections = {text.splitlines()[0]: text.strip() + "\n" for text in [*old, new]}
    order = [f"## {mode.capitalize()}" for mode in TABLES]
    place = {title: number for number, title in enumerate(order)}
    return "\n".join([PAGE, *(sections[title] for title in sorted(sections, key=lambda t: place.get(t, len(order))))])


def _stage(o: JobResult, stage: str) -> float:
    return float(o.metrics["timing"]["stages"].get(stage, 0.0))


def _seconds(o: JobResult) -> float:
    return float(o.metrics["timing"]["seconds_total"])
