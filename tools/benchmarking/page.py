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
    stage_seconds,
    stages,
)
from benchmarking.picture import drawable
from benchmarking.plan import EVERYTHING, GROWTH
from benchmarking.summary import summary_table
from benchmarking.work import JobResult

from slam.results.error_columns import DASH
from slam.runtime.storage.record import Missing, known

PICTURE = "images/trajectories.png"  # beside the page
PAGE = """# Benchmarks

Written by `tools/benchmark.py`, which says with `--help` how. Each section names the commit and the seeds that it was
measured with. A seed is `--seed` of the run, which seeds its RANSAC draws and nothing else: images, worlds and weights
are the same for every seed, and a standard deviation over seeds is that of the draws alone, neither of training nor of
data. Position errors (ATE RMSE) are in metres, mean ± standard deviation over seeds where they differ; *scale* is the
factor that the optimised trajectory still needs.

An experiment beside these runs, kiss-icp on the point clouds of learned depth, is described in
[design/tried-without-success](design/tried-without-success.md).
"""


def accuracy_tables(results: Sequence[JobResult]) -> str:
    """The errors and a picture of every drive."""
    return error_tables(results, f"\n\n![every drive from above]({PICTURE})" if drawable(results) else "")


def error_tables(results: Sequence[JobResult], picture: str = "") -> str:
    """One row for each kind of drive, then one for each sequence and weights."""
    definitions = (FRAMES, LENGTH, *ERRORS, PERCENT, OF_NETWORK, R_REL, SCALE)
    definitions += (LOOPS, FALSE_LOOPS, COVERAGE, RATE, MEMORY)
    columns = {q.title: over_seeds(q) for q in definitions}
    return f"""Every kind of drive: median and, in brackets, the worst run. ATE is that of the optimised
trajectory, 7-dof; a loop is false that is more than {FALSE_M:g} m or {FALSE_DEG:g} degrees off the truth.

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
    return f"""Errors over those of the same sequence, weights and seed with everything on, geometric mean and worst:
above 1, the part helps. The rest are means.

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
    return f"""Everything on. Frames a second count all from the first image to the evaluation; the whole command also
start and report.

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
2 m before it.

{table(rows, {q.title: over_seeds(q) for q in MAP_ERRORS}, results)}

Sizes and cost:

{sizes}{notes(results, (*MAP_ERRORS, *costs))}"""


TABLES: dict[str, Callable[[Sequence[JobResult]], str]] = {
    "accuracy": accuracy_tables,
    "full-size": error_tables,
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
        return f"{math.exp(fmean(map(math.log, ratios))):.2f} ({max(ratios):.2f})" if ratios else DASH

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
        [1e3 * _stage(o, stage) / frames for o in group if (frames := known(o.metrics.sequence.frames))], 2
    )


def notes(results: Sequence[JobResult], definitions: Iterable[MetricDefinition]) -> str:
    """Leaks, reasons of missing numbers, and failed runs, a line each."""
    lines: dict[str, None] = {}
    for o in (o for o in results if not o.reason):
        if o.metrics.provenance.leak is True:
            lines[f"LEAK: weights {o.job.weights} saw frames of {o.job.drive.name} in training."] = None
        for definition in definitions:
            value = definition.value(o)
            if isinstance(value, Missing):
                lines[f"{DASH} {definition.title}, {o.job.drive.name}: {value.reason}."] = None
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
    return known(stage_seconds(o, stage)) or 0.0


def _seconds(o: JobResult) -> float:
    return known(o.metrics.timing.seconds_total) or math.nan
