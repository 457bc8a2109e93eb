"""The report of a run: one self-contained page with a verdict, its inputs, errors and figures."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from slam.formats.trajectory import Trajectory
from slam.results.folder import RunFolder
from slam.results.metrics import METRES, LoopsFile, Metrics
from slam.results.report import tables as report_tables
from slam.results.report.map_report import map_errors_table, map_filters, map_sizes
from slam.results.report.map_view import MapView
from slam.results.report.rendering import Picture, render
from slam.results.report.tables import Cell, Table, number
from slam.results.report.verdict import verdict
from slam.runtime.errors import RunError, SlamError
from slam.runtime.run_files import LOOPS, MEANINGS, REFERENCE, REPORT, TRAJECTORIES
from slam.runtime.storage.record import NOT_RECORDED, Record

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

logger = logging.getLogger(__name__)

_ALIGNED = "Each estimate is aligned to the ground truth by rotation, translation and one scale."
_AS_WRITTEN = "As written; no ground truth is known. The raw network chain is scaled to the rest."
_NOISE = (
    "Share of factors whose error at the truth lies inside a bound of their stated noise; dashed is what the bound "
    "promises. Less means sigmas that are too small, more means sigmas that are too large."
)


def write_report(
    folder: RunFolder,
    depths: Sequence[Picture] = (),
    loops: Sequence[Picture] = (),
    view: MapView | None = None,
    metrics: Metrics | None = None,
) -> None:
    """Write ``report.html`` from the files of a folder; also for a failed run.

    Args:
        folder: the run, with its trajectories written.
        depths: strips of images and their depth.
        loops: pairs of images of accepted loops.
        view: of the map, or None without one.
        metrics: of the run; None reads ``metrics.json``.

    Raises:
        RunError: ``metrics.json`` is damaged.
    """
    metrics, loops_file = metrics or folder.metrics(), _loops_file(folder)
    page = render(
        "page.html.j2",
        name=metrics.sequence.name or folder.path.resolve().name,
        failure=metrics.failure,
        verdict=verdict(metrics),
        leak=metrics.provenance.leak is True,
        version=metrics.provenance.version or "",
        unit_notes=metrics.unit_notes(),
        key_numbers=[] if metrics.failure else report_tables.key_numbers(metrics),
        what_ran=report_tables.what_ran(metrics),
        plots=_plots(metrics, _trajectories(folder), loops_file, view),
        errors=report_tables.errors(metrics),
        gps=report_tables.gps(metrics),
        no_errors=report_tables.no_errors(metrics),
        depths=depths,
        depth_error=_depth_error(metrics),
        map=map_sizes(metrics),
        map_filters=map_filters(metrics),
        map_errors=map_errors_table(metrics),
        no_map=_absence(metrics, metrics.map),
        loops=report_tables.loops(metrics, loops_file),
        loop_pictures=loops,
        no_loops=_absence(metrics, metrics.loops),
        tracking=report_tables.tracking(metrics),
        graph=report_tables.graph(metrics),
        timing=report_tables.timing(metrics),
        alignments=report_tables.alignments(metrics),
        files=_files(folder),
    )
    folder.write_text(REPORT, page)


def _loops_file(folder: RunFolder) -> LoopsFile:
    """``loops.json``; empty where the file is missing or damaged."""
    try:
        return LoopsFile.read(folder.path / LOOPS)
    except (OSError, RunError):
        return LoopsFile()


def _absence(metrics: Metrics, part: Record) -> str:
    """Why a run has no such part; empty where it has one, or failed before."""
    return "" if metrics.failure and part.absent == NOT_RECORDED else part.absent


def _plots(
    metrics: Metrics, trajectories: Mapping[str, Trajectory], loops: LoopsFile, view: MapView | None
) -> dict[str, list[Picture]]:
    """The plots of every section; one that cannot be drawn (trajectories without common stamps) has the reason."""
    from slam.results.report import figures

    found: dict[str, list[Picture]] = {"trajectories": [], "errors": [], "map": [], "noise": []}

    def add(section: str, title: str, caption: str, draw: Callable[..., Figure], *given: Any) -> None:
        try:
            found[section].append(Picture.of_plot(title, caption, draw(*given)))
        except SlamError as error:
            found[section].append(Picture(title, caption, reason=str(error)))

    has_truth = REFERENCE in trajectories and len(trajectories) > 1
    unit = "m" if metrics.unit == METRES else metrics.unit
    gaps, accepted = metrics.sequence.bridged or [], loops.accepted or []
    if trajectories:
        given = (trajectories, "m" if has_truth else unit, accepted)
        caption = _ALIGNED if has_truth else _AS_WRITTEN
        add("trajectories", "Trajectories from above", caption, figures.trajectories_figure, *given)
    if has_truth:
        how = "as written, the network after the 7-dof alignment" if metrics.is_metric else "after the 7-dof alignment"
        caption = f"Lengths of stretches of 1/25 of the path, {how}; rotation after it. Interpolated frames are shaded."
        title = "Scale and rotation over time"
        add("trajectories", title, caption, figures.scale_figure, trajectories, metrics.is_metric, gaps)
        caption = "Distance to the true position, after the 7-dof alignment."
        add("errors", "Position error along the path", caption, figures.error_figure, trajectories)
        caption = "Mean relative error of all segments of a length; the scale is that of the 7-dof alignment."
        add("errors", "Drift by the length of segments", caption, figures.drift_figure, trajectories)
    elif trajectories:
        caption = "Speed, and the angles of the optimised trajectory. Interpolated frames are shaded."
        add("trajectories", "Speed and rotation over time", caption, figures.motion_figure, trajectories, unit, gaps)
    if view is not None:
        caption = (
            f"A thinned map_mesh.ply with the optimised trajectory, seen first from the camera of frame {view.seat}. "
            "Drag to turn it, with the right button to move it; the wheel zooms."
        )
        add("map", "Map", caption, figures.map_figure, view)
    if not (coverage := metrics.graph.coverage).absent:
        by_source = metrics.graph.coverage_by_source or {}
        add("noise", "Stated noise", _NOISE, figures.noise_figure, coverage, by_source)
    return found


def _depth_error(metrics: Metrics) -> Table | None:
    """Error of learned depth over distance; None where it was not measured."""
    rows = metrics.depth_error
    if not rows:
        return None
    words = (
        "Learned depth against depth triangulated on the drive. The bias is taken out of learned depth before it is "
        "compared with image geometry. It is zero on average, for its scale is measured step by step."
    )
    head = ("learned depth", "bias", "relative sigma", "corners")
    cells = [
        [number(row, "depth", 1), Cell(f"{row.bias or 0.0:+.2f}"), number(row, "sigma", 2), number(row, "corners")]
        for row in rows
    ]
    return Table(head, cells, notes=[words])


def _files(folder: RunFolder) -> Table | None:
    """Every other file of the run with its meaning and size."""
    rows = []
    for path in sorted(folder.path.iterdir()):
        if path.is_file() and not path.name.startswith(".") and path.name != REPORT:
            size = _size(path.stat().st_size)
            rows.append([Cell(path.name, address=quote(path.name)), Cell(MEANINGS.get(path.name, "")), Cell(size)])
    return Table((), rows, "words") if rows else None


def _trajectories(folder: RunFolder) -> dict[str, Trajectory]:
    """The trajectories to draw, the reference first; none if a file is damaged, so that the report is still written."""
    try:
        found = {name: folder.trajectory(name) for name in (REFERENCE, *TRAJECTORIES)}
    except SlamError as error:
        logger.info("the report shows no trajectories: %s", error)
        return {}
    return {name: trajectory for name, trajectory in found.items() if trajectory is not None}


def _size(count: int) -> str:
    size = float(count)
    for unit in ("B", "kB", "MB"):
        if size < 1000.0:
            return f"{size:.3g} {unit}"
        size /= 1000.0
    return f"{size:.3g} GB"
