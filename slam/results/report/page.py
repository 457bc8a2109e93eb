"""The report of a run: one self-contained page with its inputs, errors and figures."""

from __future__ import annotations

import base64
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined

from slam.formats.trajectory import Trajectory
from slam.frames import DepthMap, Image
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics
from slam.results.report import tables as report_tables
from slam.results.report.map_report import has_map_curve, map_error_figure, map_errors_table, map_filters, map_sizes
from slam.results.report.map_view import MapViews
from slam.results.report.plots import (
    depth_figure,
    length_unit,
    png,
    trajectories_figure,
    trajectories_of,
)
from slam.results.report.tables import Cell, Table, number
from slam.runtime.errors import SlamError
from slam.runtime.run_files import LOOPS, MEANINGS, REFERENCE, REPORT
from slam.runtime.storage.record import MISSING, Missing, known

if TYPE_CHECKING:
    from matplotlib.figure import Figure

logger = logging.getLogger(__name__)

_TEMPLATES = Environment(
    loader=PackageLoader("slam", "results/report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)


@dataclass(frozen=True, eq=False)
class DepthExample:
    """A frame with its learned depth: ``image`` ``(H, W, 3)`` uint8 RGB, ``depth`` ``(H, W)``, any unit."""

    index: int
    image: Image
    depth: DepthMap


@dataclass(frozen=True)
class Picture:
    """A figure as a base64 PNG, or why it could not be drawn."""

    title: str
    caption: str
    data: str = ""
    reason: str = ""


def write_report(
    folder: RunFolder,
    examples: Sequence[DepthExample],
    views: MapViews | None,
) -> None:
    """Write ``report.html`` from the files of a folder; also for a failed run.

    Args:
        folder: the run, with its ``metrics.json`` and trajectories written.
        examples: frames to show with their depth.
        views: of the map, or None without one.

    Raises:
        RunError: ``metrics.json`` is damaged.
    """
    metrics = folder.metrics()
    name = known(metrics.sequence.name) or folder.path.resolve().name
    trajectories, unit = _trajectories(folder), length_unit(folder)
    page = _TEMPLATES.get_template("page.html.j2").render(
        name=name,
        failure=metrics.failure,
        leak=metrics.provenance.leak is True,
        version=known(metrics.provenance.version) or "",
        unit_notes=metrics.unit_notes(),
        key_numbers=[] if metrics.failure else report_tables.key_numbers(metrics),
        what_ran=report_tables.what_ran(metrics),
        trajectories=_trajectory_picture(trajectories, unit),
        errors=report_tables.errors(metrics),
        gps=report_tables.gps(metrics),
        no_errors=report_tables.no_errors(metrics),
        error_pictures=list(_error_pictures(trajectories)),
        depth=_depth_picture(examples),
        depth_error=_depth_error(metrics),
        map_picture=_map_picture(views),
        driver=_driver_picture(views),
        viewer=None if views is None else views.viewer,
        map=map_sizes(metrics),
        map_filters=map_filters(metrics),
        map_errors=map_errors_table(metrics),
        map_curve=_map_curve(metrics),
        no_map=_absence(metrics, metrics.map),
        loops=report_tables.loops(metrics, folder.path / LOOPS),
        no_loops=_absence(metrics, metrics.loops),
        tracking=report_tables.tracking(metrics),
        graph=report_tables.graph(metrics),
        timing=report_tables.timing(metrics),
        alignments=report_tables.alignments(metrics),
        files=_files(folder),
    )
    folder.write_text(REPORT, page)


def _absence(metrics: Metrics, part: object) -> str:
    """Why a run has no such part; empty where it has one, or failed before."""
    if not isinstance(part, Missing) or (metrics.failure and part == MISSING):
        return ""
    return part.reason


def _trajectory_picture(trajectories: Mapping[str, Trajectory], unit: str) -> Picture | None:
    if not trajectories:
        return None
    if REFERENCE in trajectories:
        caption = (
            "Seen from above. Each estimate is aligned to the ground truth by rotation, translation and one scale."
        )
    else:
        caption = "Seen from above, as written; no ground truth is known. The raw network chain is scaled to the rest."
    return _drawn(
        lambda: trajectories_figure("trajectory", trajectories, unit=unit), "Trajectories from above", caption
    )


def _error_pictures(trajectories: Mapping[str, Trajectory]) -> Iterator[Picture]:
    if REFERENCE not in trajectories or len(trajectories) < 2:
        return
    caption = "Distance to the true position, after the 7-dof alignment."
    yield _drawn(lambda: trajectories_figure("errors", trajectories), "Position error over distance travelled", caption)
    caption = "Mean relative error of all segments of a length; the scale is that of the 7-dof alignment."
    yield _drawn(lambda: trajectories_figure("drift", trajectories), "Drift over segment length", caption)


def _depth_error(metrics: Metrics) -> Table | None:
    """Error of learned depth over distance; None where it was not measured."""
    rows = list(metrics.depth_error)
    if not rows:
        return None
    words = (
        "Learned depth against depth triangulated on the drive. The bias is taken out of learned depth before it is "
        "compared with image geometry. It is zero on average, for its scale is measured step by step."
    )
    head = ("learned depth", "bias", "relative sigma", "corners")
    cells = [[number(row.depth, 1), _signed(row.bias), number(row.sigma, 2), number(row.corners)] for row in rows]
    return Table(head, cells, notes=[words])


def _signed(value: float | Missing) -> Cell:
    return number(value) if isinstance(value, Missing) else Cell(f"{value:+.2f}")


def _depth_picture(examples: Sequence[DepthExample]) -> Picture | None:
    if not examples:
        return None
    labels = [f"frame {example.index}" for example in examples]
    caption = "Frames above their learned disparity: bright is near, dark is far, one colour scale for all."
    images, depths = [example.image for example in examples], [example.depth for example in examples]
    return _drawn(lambda: depth_figure(images, depths, labels), "Depth maps", caption)


def _map_picture(views: MapViews | None) -> Picture | None:
    if views is None:
        return None
    return Picture("Map from above", "The map from above in its own colours.", _encoded(views.above))


def _driver_picture(views: MapViews | None) -> Picture | None:
    if views is None:
        return None
    caption = f"The map from the driver's seat at frame {views.frame}."
    return Picture("Map from the driver's seat", caption, _encoded(views.driver))


def _map_curve(metrics: Metrics) -> Picture | None:
    if not has_map_curve(metrics):
        return None
    caption = "Error of the map by the distance of its points, and of the true surface, from the nearest camera."
    return _drawn(lambda: map_error_figure(metrics), "Map error over distance", caption)


def _files(folder: RunFolder) -> Table | None:
    """Every other file of the run with its meaning and size."""
    rows = []
    for path in sorted(folder.path.iterdir()):
        if path.is_file() and not path.name.startswith(".") and path.name != REPORT:
            size = _size(path.stat().st_size)
            rows.append([Cell(path.name, address=quote(path.name)), Cell(MEANINGS.get(path.name, "")), Cell(size)])
    return Table((), rows, "words") if rows else None


def _trajectories(folder: RunFolder) -> dict[str, Trajectory]:
    """Trajectories to draw; none if a file is damaged or missing, so that the report is still written."""
    try:
        return trajectories_of(folder)
    except SlamError as error:
        logger.info("the report shows no trajectories: %s", error)
        return {}


def _drawn(draw: Callable[[], Figure], title: str, caption: str) -> Picture:
    """A picture, or why it cannot be drawn (for example, trajectories without common stamps)."""
    try:
        return Picture(title, caption, _encoded(png(draw())))
    except SlamError as error:
        return Picture(title, caption, reason=str(error))


def _encoded(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _size(count: int) -> str:
    size = float(count)
    for unit in ("B", "kB", "MB"):
        if size < 1000.0:
            return f"{size:.3g} {unit}"
        size /= 1000.0
    return f"{size:.3g} GB"
