"""The report of a run: one self-contained page with its inputs, errors and figures."""

from __future__ import annotations

import base64
import io
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined

from slam.evaluation.drift import REFERENCE
from slam.formats.trajectory import Trajectory
from slam.frames import DepthMap, Image
from slam.results.comparison import failure, lookup, unit_notes
from slam.results.folder import RunFolder
from slam.results.report import tables as report_tables
from slam.results.report.map_report import has_map_curve, map_error_figure, map_errors_table, map_filters, map_sizes
from slam.results.report.map_view import MAP_ABOVE, MAP_DRIVER, MapViews
from slam.results.report.plots import (
    depth_figure,
    drift_figure,
    errors_figure,
    length_unit,
    trajectories_of,
    trajectory_figure,
)
from slam.results.report.tables import Cell, Table
from slam.runtime.errors import SlamError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

logger = logging.getLogger(__name__)

Metrics = Mapping[str, Any]

REPORT = "report.html"
_TEMPLATES = Environment(
    loader=PackageLoader("slam", "results/report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_MEANINGS = {
    "config.yaml": "resolved configuration",
    "metrics.json": "every number of this page",
    "trajectory_optimised.geojson": "optimised trajectory on the earth",
    "trajectory_network": "raw network poses, chained",
    "trajectory_odometry": "front end fused, no loops",
    "trajectory_optimised": "after the pose graph",
    "trajectory_lidar": "KISS-ICP on the LiDAR scans",
    "reference": "ground truth",
    "graph.g2o": "pose graph",
    "loops.json": "accepted and rejected loops",
    "places.npz": "features of places, for localize",
    "drive.zip": "measurements of every frame, for run --continue",
    "keyframes.npz": "keyframes of the map, for run --continue",
    "map_mesh.ply": "map as a mesh, y down",
    "map_cloud.ply": "map as a coloured cloud, y down",
    MAP_ABOVE: "the map from above",
    MAP_DRIVER: "the map from the driver's seat",
    "run.log": "log of the run",
}


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
    name = str(lookup(metrics, "sequence", "name")[0] or folder.path.resolve().name)
    trajectories, unit = _trajectories(folder), length_unit(folder)
    page = _TEMPLATES.get_template("page.html.j2").render(
        name=name,
        failure=failure(metrics),
        leak=lookup(metrics, "provenance", "leak")[0],
        version=lookup(metrics, "provenance", "version")[0] or "",
        unit_notes=unit_notes(metrics),
        key_numbers=[] if failure(metrics) else report_tables.key_numbers(metrics),
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
        no_map=_absence(metrics, "map"),
        loops=report_tables.loops(metrics, folder.path / "loops.json"),
        no_loops=_absence(metrics, "loops"),
        tracking=report_tables.tracking(metrics),
        graph=report_tables.graph(metrics),
        timing=report_tables.timing(metrics),
        alignments=report_tables.alignments(metrics),
        files=_files(folder),
    )
    folder.write_text(REPORT, page)


def _absence(metrics: Metrics, name: str) -> str:
    """Why a run has no such part; empty where it has one, or failed before."""
    part, reason = lookup(metrics, name)
    return "" if part is not None or (failure(metrics) and name not in metrics) else reason


def _trajectory_picture(trajectories: Mapping[str, Trajectory], unit: str) -> Picture | None:
    if not trajectories:
        return None
    if REFERENCE in trajectories:
        caption = (
            "Seen from above. Each estimate is aligned to the ground truth by rotation, translation and one scale."
        )
    else:
        caption = "Seen from above, as written; no ground truth is known. The raw network chain is scaled to the rest."
    return _drawn(lambda: trajectory_figure(trajectories, unit=unit), "Trajectories from above", caption)


def _error_pictures(trajectories: Mapping[str, Trajectory]) -> Iterator[Picture]:
    if REFERENCE not in trajectories or len(trajectories) < 2:
        return
    caption = "Distance to the true position, after the 7-dof alignment."
    yield _drawn(lambda: errors_figure(trajectories), "Position error over distance travelled", caption)
    caption = "Mean relative error of all segments of a length; the scale is that of the 7-dof alignment."
    yield _drawn(lambda: drift_figure(trajectories), "Drift over segment length", caption)


def _depth_error(metrics: Mapping[str, Any]) -> Table | None:
    """Error of learned depth over distance; None where it was not measured."""
    rows, _ = lookup(metrics, "depth_error")
    if not rows:
        return None
    words = (
        "Learned depth against depth triangulated on the drive. The bias is taken out of learned depth before it is "
        "compared with image geometry. It is zero on average, for its scale is measured step by step."
    )
    head = ("learned depth", "bias", "relative sigma", "corners")
    cells = [(f"{r['depth']:.1f}", f"{r['bias']:+.2f}", f"{r['sigma']:.2f}", f"{r['corners']:.0f}") for r in rows]
    return Table(head, [[Cell(text) for text in row] for row in cells], notes=[words])


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
            meaning = _MEANINGS.get(path.name) or _MEANINGS.get(path.name.partition(".")[0], "")
            size = _size(path.stat().st_size)
            rows.append([Cell(path.name, address=quote(path.name)), Cell(meaning), Cell(size)])
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
    buffer = io.BytesIO()
    try:
        draw().savefig(buffer, format="png", dpi=160, metadata={"Software": None})
    except SlamError as error:
        return Picture(title, caption, reason=str(error))
    return Picture(title, caption, _encoded(buffer.getvalue()))


def _encoded(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _size(count: int) -> str:
    size = float(count)
    for unit in ("B", "kB", "MB"):
        if size < 1000.0:
            return f"{size:.3g} {unit}"
        size /= 1000.0
    return f"{size:.3g} GB"
