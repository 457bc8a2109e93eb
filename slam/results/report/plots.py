"""Figures for a paper: trajectories, errors, drift, and the map from above.

Colours are those of Okabe and Ito (2008), distinct for colour-blind readers; line styles are distinct in
grey. Matplotlib is imported inside the functions, without changes of its global state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.figure_file import require_figure, save_figure
from slam.evaluation.drift import aligned, paired, segment_drifts
from slam.formats.trajectory import Trajectory
from slam.geometry.se3 import path_distance
from slam.results.folder import RunFolder
from slam.results.metrics import METRES
from slam.runtime.errors import RunError
from slam.runtime.run_files import REFERENCE, TRAJECTORIES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "axes.labelsize": 10,
    "axes.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e3e6ea",
    "grid.linewidth": 0.7,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "svg.hashsalt": "erfsfm-slam",
}
LOOKS: dict[str, tuple[str, dict[str, Any]]] = {
    REFERENCE: ("Ground truth", {"color": "black", "linestyle": (0, (4, 2)), "linewidth": 1.2, "zorder": 4}),
    "network": ("Network, chained", {"color": "#e69f00", "linestyle": "-", "linewidth": 1.3}),
    "odometry": ("Odometry", {"color": "#cc79a7", "linestyle": (0, (6, 1.5, 1, 1.5)), "linewidth": 1.5}),
    "optimised": ("Optimised", {"color": "#0072b2", "linestyle": "-", "linewidth": 2.0}),
    "lidar": ("LiDAR (KISS-ICP)", {"color": "#009e73", "linestyle": (0, (1, 1)), "linewidth": 1.8}),
}
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # of systems
_MOST_COLUMNS = 12
_STROKES = ("-", (0, (6, 1.5)), (0, (1, 1)))


def draw_trajectories(canvas: FigureBase, trajectories: Mapping[str, Trajectory], unit: str) -> list[Axes]:
    """Draw the top view on a figure or a part of one."""
    axes = canvas.subplots()
    has_reference = REFERENCE in trajectories
    looks = _looks(trajectories)
    for name, trajectory in aligned(trajectories).items():
        label, look = looks[name]
        if not has_reference and name == "network" and "optimised" in trajectories:
            label += " (scaled)"
        axes.plot(trajectory.positions[:, 0], trajectory.positions[:, 2], label=label, **look)
    start = trajectories[REFERENCE if has_reference else next(iter(trajectories))].positions[0]
    marker: dict[str, Any] = {"marker": "o", "markersize": 6.5, "markerfacecolor": "white", "markeredgewidth": 1.3}
    axes.plot(start[0], start[2], color="black", linestyle="", zorder=5, label="Start", **marker)
    unit = "m" if has_reference else unit
    axes.set(xlabel=f"x, right ({unit})", ylabel=f"z, ahead ({unit})")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    axes.legend(title="Estimates aligned by 7 dof" if has_reference else None, title_fontsize=9, **_beside())
    return [axes]


def draw_errors(canvas: FigureBase, trajectories: Mapping[str, Trajectory], unit: str) -> list[Axes]:
    """Draw the position error on a figure or a part of one."""
    axes, looks = canvas.subplots(), _looks(trajectories)
    for name, estimate, truth in paired(trajectories):
        error = np.linalg.norm(estimate.positions - truth.positions, axis=1)
        label, look = looks[name]
        axes.plot(path_distance(truth.T_world_camera), error, label=label, **look)
    axes.set(xlabel="distance travelled (m)", ylabel="position error (m), 7 dof")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.legend(**_beside())
    return [axes]


def draw_drift(canvas: FigureBase, trajectories: Mapping[str, Trajectory], unit: str) -> list[Axes]:
    """Draw translation and rotation drift on a figure or a part of one."""
    left, right = canvas.subplots(1, 2)
    looks, lengths = _looks(trajectories), set[float]()
    for name, estimate, truth in paired(trajectories):
        drifts = segment_drifts(estimate, truth)
        length = [drift.length_m for drift in drifts]
        lengths.update(length)
        label, look = looks[name]
        look = look | {"marker": "o", "markersize": 3.5}
        left.plot(length, [100.0 * drift.translation for drift in drifts], label=label, **look)
        right.plot(length, [np.rad2deg(100.0 * drift.rotation) for drift in drifts], label=label, **look)
    left.set_ylabel("translation error (%), 7 dof")
    right.set_ylabel("rotation error (deg / 100 m)")
    for axes in (left, right):
        axes.set_xlabel("segment length (m)")
        axes.set_ylim(bottom=0)
        if not lengths:
            axes.text(0.5, 0.5, "path shorter than 10 m", ha="center", transform=axes.transAxes)
        elif max(lengths) <= 100.0:
            axes.set_xticks(sorted(lengths))
    canvas.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return [left, right]


PANELS = {"trajectory": draw_trajectories, "errors": draw_errors, "drift": draw_drift}


@dataclass(frozen=True)
class AerialView:
    """The map seen straight from above: ``image`` ``(H, W, 4)`` uint8 RGBA, z ahead is up, and its limits."""

    image: NDArray[np.uint8]
    x: tuple[float, float]
    z: tuple[float, float]


def map_figure(view: AerialView, trajectory: Trajectory | None = None, unit: str = "m") -> Figure:
    """The map from above in its colours, with the trajectory over it.

    Args:
        view: the map as an image.
        trajectory: camera poses in the same world.
        unit: of all lengths.
    """
    with figure_style() as new_figure:
        share = (view.z[1] - view.z[0]) / (view.x[1] - view.x[0])
        figure = new_figure(figsize=(7.4, np.clip(6.4 * share + 1.0, 2.6, 7.0)), layout="constrained")
        axes = figure.subplots()
        axes.imshow(view.image, extent=(*view.x, *view.z), interpolation="antialiased", zorder=2)
        if trajectory:
            path = trajectory.positions[:, [0, 2]]
            look = LOOKS["optimised"][1] | {"linewidth": 1.2, "zorder": 4}
            axes.plot(path[:, 0], path[:, 1], color="white", linewidth=2.6, zorder=3)
            axes.plot(path[:, 0], path[:, 1], **look, label="Optimised trajectory")
            figure.legend(loc="outside upper center")
        axes.set_aspect("equal")
        axes.set(xlim=view.x, ylim=view.z, xlabel=f"x, right ({unit})", ylabel=f"z, ahead ({unit})")
    return figure


def plot_systems(trajectories: Mapping[str, Trajectory], what: Sequence[str], output: Path) -> None:
    """Write one figure of trajectories over each other, a row for each of ``what``; raises as `plot_runs`.

    Args:
        trajectories: by the name of their system; ``reference`` is the truth.
        what: of `PANELS`.
        output: the file to write.
    """
    rows = _panels(what)
    require_figure(output)
    with figure_style() as new_figure:
        figure = new_figure(figsize=(7.4, sum(map(_height, rows))), layout="constrained")
        grid = figure.subfigures(len(rows), 1, squeeze=False, height_ratios=[*map(_height, rows)])
        for name, part in zip(rows, grid[:, 0]):
            PANELS[name](part, trajectories, "as in the file")
        _save(figure, output)


def plot_runs(runs: Sequence[RunFolder], what: Sequence[str], output: Path) -> None:
    """Write one figure: a column for each run, a row for each of ``what``.

    Raises:
        RunError: an unknown ``what``, too many runs, or a run without what the figure needs.
        ConfigError: as `require_figure`.
    """
    what = _panels(what)
    if len(runs) > _MOST_COLUMNS:
        raise RunError(f"{len(runs)} runs are wider than a page: give {_MOST_COLUMNS}, or files, which share a figure")
    require_figure(output)
    contents = [trajectories_of(run, needs_reference=set(what) != {"trajectory"}) for run in runs]
    heights = [*map(_height, what)]
    with figure_style() as new_figure:
        figure = new_figure(figsize=(7.4 * len(runs), sum(heights)), layout="constrained")
        grid = figure.subfigures(len(what), len(runs), squeeze=False, height_ratios=heights)
        for name, row in zip(what, grid):
            drawn = [PANELS[name](part, each, length_unit(run)) for part, each, run in zip(row, contents, runs)]
            if name != "trajectory":
                _share_heights(drawn)
        for part, run in zip(grid[0], runs):
            part.suptitle(run.path.resolve().name, fontsize=12)
        _save(figure, output)


def trajectories_of(run: RunFolder, needs_reference: bool = False) -> dict[str, Trajectory]:
    """The trajectories of a run, the reference first.

    Raises:
        RunError: there is none, or no reference where one is needed.
    """
    found = {name: run.trajectory(name) for name in (REFERENCE, *TRAJECTORIES)}
    trajectories = {name: trajectory for name, trajectory in found.items() if trajectory is not None}
    if not trajectories:
        raise RunError(f"{run.path} holds no trajectory: run the sequence again")
    if needs_reference:
        if REFERENCE not in trajectories:
            raise RunError(f"{run.path} has no reference: errors and drift need ground truth; plot --what trajectory")
        if len(trajectories) == 1:
            raise RunError(f"{run.path} holds no estimated trajectory: run the sequence again")
    return trajectories


def length_unit(run: RunFolder) -> str:
    """The unit of a run's trajectories and map, for the axes of a plot."""
    return "m" if (unit := run.metrics().unit) == METRES else unit


@contextmanager
def figure_style() -> Iterator[Callable[..., Figure]]:
    """The figure class under our style; without pyplot it leaves no global state."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        yield Figure


def _panels(what: Sequence[str]) -> list[str]:
    names = [name.strip() for name in what]
    unknown = [name for name in names if name not in PANELS]
    if unknown:
        raise RunError(f"--what {unknown[0]!r} is unknown: give some of {', '.join(PANELS)}")
    return names


def _height(panel: str) -> float:
    return 4.6 if panel == "trajectory" else 3.2


def _save(figure: Figure, output: Path) -> None:
    try:
        save_figure(figure, output, dpi=200)
    except OSError as error:
        raise RunError(str(error)) from error


def _looks(names: Iterable[str]) -> dict[str, tuple[str, dict[str, Any]]]:
    """Label and style of every trajectory; those of other systems in the order given."""
    names = list(names)
    others = [name for name in names if name not in LOOKS]
    looks = {}
    for k, name in enumerate(others):
        stroke = _STROKES[k // len(COLOURS) % len(_STROKES)]
        looks[name] = (name, {"color": COLOURS[k % len(COLOURS)], "linestyle": stroke, "linewidth": 1.5})
    return {name: looks.get(name) or LOOKS[name] for name in names}


def _beside() -> dict[str, Any]:
    return {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.2}


def _share_heights(drawn: Sequence[Sequence[Axes]]) -> None:
    """Set one upper limit for the axes of a row, so that runs can be compared."""
    for same in zip(*drawn):
        top = max(axes.get_ylim()[1] for axes in same)
        for axes in same:
            axes.set_ylim(0.0, top)
