"""Small multiples: every drive from above, before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from benchmarking.cells import drive, grouped
from benchmarking.work import Outcome
from matplotlib.figure import Figure

from slam.files import write_atomically
from slam.plots import draw_trajectories, trajectories_of
from slam.run_folder import RunFolder

SIDE_IN = 1.9
DPI = 90


def drawable(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The first run of every drive that ended well."""
    return [runs[0] for runs in grouped([o for o in outcomes if not o.reason], drive).values()]


def draw(outcomes: Sequence[Outcome], path: Path) -> None:
    """Network, odometry and optimised trajectory over the truth, a panel a drive."""
    chosen = drawable(outcomes)
    columns = math.ceil(math.sqrt(1.6 * len(chosen)))
    rows = math.ceil(len(chosen) / columns)
    figure = Figure(figsize=(columns * SIDE_IN, rows * SIDE_IN + 0.5), layout="constrained")
    panels = figure.subfigures(rows, columns, squeeze=False).flat
    for o, panel in zip(chosen, panels):
        [axes] = draw_trajectories(panel, trajectories_of(RunFolder.open(o.job.place / "run")), "")
        axes.get_legend().remove()
        axes.set(xlabel="", ylabel="")
        axes.set_title(drive(o), fontsize=8)
        axes.tick_params(labelsize=6)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda file: figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None}))
