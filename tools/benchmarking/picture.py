"""Small multiples: every drive from above, before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from benchmarking.cells import drive, grouped
from benchmarking.work import JobResult
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from slam.results.folder import RunFolder
from slam.results.report.plots import draw_trajectories, trajectories_of
from slam.runtime.storage.files import write_atomically

SIDE_IN = 1.9
DPI = 90
COLOURS = 48  # a third of the bytes of a full palette, without a visible difference


def drawable(results: Sequence[JobResult]) -> list[JobResult]:
    """The first run of every drive that ended well."""
    return [runs[0] for runs in grouped([o for o in results if not o.reason], drive).values()]


def draw(results: Sequence[JobResult], path: Path) -> None:
    """Network, odometry and optimised trajectory over the truth, a panel a drive."""
    chosen = drawable(results)
    columns = math.ceil(math.sqrt(1.6 * len(chosen)))
    rows = math.ceil(len(chosen) / columns)
    figure = Figure(figsize=(columns * SIDE_IN, rows * SIDE_IN + 0.5), dpi=DPI, layout="constrained")
    panels = figure.subfigures(rows, columns, squeeze=False).flat
    for o, panel in zip(chosen, panels):
        [axes] = draw_trajectories(panel, trajectories_of(RunFolder.open(o.job.place / "run")), "")
        legend = axes.get_legend()
        if legend is not None:
            legend.remove()
        axes.set(xlabel="", ylabel="")
        axes.set_title(drive(o), fontsize=8)
        axes.tick_params(labelsize=6)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(columns, len(labels)), fontsize=9)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    light = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).quantize(COLOURS)
    write_atomically(path, lambda file: light.save(file, format="png", optimize=True))
