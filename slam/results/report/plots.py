"""Figures of trajectories and of the map from above.

Colours are those of Okabe and Ito (2008), distinct for colour-blind readers; line styles are distinct in
grey. Matplotlib is imported inside the functions, without changes of its global state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slam.evaluation.drift import aligned
from slam.formats.trajectory import Trajectory
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


def trajectories_of(run: RunFolder) -> dict[str, Trajectory]:
    """The trajectories of a run, the reference first.

    Raises:
        RunError: there is none.
    """
    found = {name: run.trajectory(name) for name in (REFERENCE, *TRAJECTORIES)}
    trajectories = {name: trajectory for name, trajectory in found.items() if trajectory is not None}
    if not trajectories:
        raise RunError(f"{run.path} holds no trajectory: run the sequence again")
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
