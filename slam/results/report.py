"""The report of a run: one page that says what ran, how good it is and why; it opens without a network."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from slam.errors import SlamError
from slam.evaluation.drift import REFERENCE
from slam.frames import DepthMap, Image
from slam.results import report_page as page
from slam.results import report_tables
from slam.results.comparison import failure, lookup, unit_notes
from slam.results.folder import RunFolder
from slam.results.plots import (
    depth_figure,
    drift_figure,
    errors_figure,
    length_unit,
    map_figure,
    trajectories_of,
    trajectory_figure,
)
from slam.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

logger = logging.getLogger(__name__)

Metrics = Mapping[str, Any]

REPORT = "report.html"
_MEANINGS = {
    "config.yaml": "resolved configuration",
    "metrics.json": "every number of this page",
    "trajectory_network": "raw network poses, chained",
    "trajectory_odometry": "front end fused, no loops",
    "trajectory_optimised": "after the pose graph",
    "trajectory_lidar": "KISS-ICP on the LiDAR scans",
    "reference": "ground truth",
    "graph.g2o": "pose graph",
    "loops.json": "loop candidates and verdicts",
    "places.npz": "features of places, for localize",
    "map_mesh.ply": "map as a mesh, y down",
    "map_cloud.ply": "map as a coloured cloud, y down",
    "run.log": "log of the run",
}


@dataclass(frozen=True, eq=False)
class DepthExample:
    """A frame with its learned depth: ``image`` ``(H, W, 3)`` uint8 RGB, ``depth`` ``(H, W)``, any unit."""

    index: int
    image: Image
    depth: DepthMap


def write_report(
    folder: RunFolder,
    examples: Sequence[DepthExample],
    map_points: NDArray[np.floating] | None,
    map_colours: NDArray[np.floating] | None,
) -> None:
    """Write ``report.html`` from what the folder holds; a run that failed gets one too.

    Args:
        folder: the run, with its ``metrics.json`` and trajectories written.
        examples: frames to show with their depth.
        map_points: ``(P, 3)`` in the world of the optimised trajectory, y down, or None without a map.
        map_colours: ``(P, 3)`` RGB in [0, 1], or None.

    Raises:
        RunError: ``metrics.json`` is damaged.
    """
    metrics = folder.metrics()
    name = str(lookup(metrics, "sequence", "name")[0] or folder.path.resolve().name)
    trajectories, unit = _trajectories(folder), length_unit(folder)
    ok = not failure(metrics)
    body = [
        *_header(name, metrics),
        page.section("What ran", report_tables.what_ran(metrics)),
        _trajectory_section(trajectories, unit),
        page.section("Errors", report_tables.errors(metrics), *_error_pictures(trajectories)),
        _depth_section(examples),
        page.section(
            "Map",
            _map_picture(trajectories.get("optimised"), unit, map_points, map_colours),
            report_tables.map_numbers(metrics) if ok else "",
        ),
        page.section("Loops", report_tables.loops(metrics, folder.path / "loops.json") if ok else ""),
        page.section("Pose graph", report_tables.graph(metrics)),
        page.section("Time", report_tables.timing(metrics)),
        page.section("Every alignment", report_tables.alignments(metrics)),
        _file_section(folder),
        _footer(metrics),
    ]
    folder.write_text(REPORT, page.page(f"{name}: erfsfm-slam report", filter(None, body)))


def _header(name: str, metrics: Metrics) -> Iterator[str]:
    yield f"<header>{page.text('erfsfm-slam report', 'kicker')}<h1>{escape(name)}</h1></header>"
    reason = failure(metrics)
    if reason:
        yield page.stamp("FAILED", reason)
    if lookup(metrics, "provenance", "leak")[0]:
        words = "The weights have seen this sequence, or a part of it, in training: the errors below are no test."
        yield page.stamp("LEAK", words)
    for note in unit_notes(metrics):
        yield page.hint(note)
    if not reason:
        yield report_tables.key_numbers(metrics)


def _trajectory_section(trajectories: Mapping[str, Trajectory], unit: str) -> str:
    if not trajectories:
        return page.section("Trajectories", page.text("No trajectory was written.", "soft"))
    if REFERENCE in trajectories:
        caption = "Seen from above. Each estimate is laid over the ground truth by rotation, translation and one scale."
    else:
        caption = "Seen from above, as written; no ground truth is known. The raw network chain is scaled to the rest."
    picture = _drawn(lambda: trajectory_figure(trajectories, unit=unit), "Trajectories from above", caption)
    return page.section("Trajectories", picture)


def _error_pictures(trajectories: Mapping[str, Trajectory]) -> Iterator[str]:
    if REFERENCE not in trajectories or len(trajectories) < 2:
        return
    caption = "Distance to the true position, after the 7-dof alignment."
    yield _drawn(lambda: errors_figure(trajectories), "Position error over distance travelled", caption)
    caption = "Mean relative error of all segments of a length; the scale is that of the 7-dof alignment."
    yield _drawn(lambda: drift_figure(trajectories), "Drift over segment length", caption)


def _depth_section(examples: Sequence[DepthExample]) -> str:
    if not examples:
        return ""
    labels = [f"frame {example.index}" for example in examples]
    figure = depth_figure([e.image for e in examples], [e.depth for e in examples], labels)
    caption = "Frames above their learned disparity: bright is near, dark is far, one colour scale for all."
    return page.section("Depth", page.picture(figure, "Depth maps", caption))


def _map_picture(
    optimised: Trajectory | None,
    unit: str,
    points: NDArray[np.floating] | None,
    colours: NDArray[np.floating] | None,
) -> str:
    if points is None or colours is None or not len(points):
        return ""
    figure = map_figure(points, colours, optimised, unit)
    return page.picture(figure, "Map from above", "The map from above in its own colours.")


def _file_section(folder: RunFolder) -> str:
    entries = []
    for path in sorted(folder.path.iterdir()):
        if path.is_file() and not path.name.startswith(".") and path.name != REPORT:
            meaning = _MEANINGS.get(path.name) or _MEANINGS.get(path.name.partition(".")[0], "")
            entries.append((quote(path.name), path.name, meaning, _size(path.stat().st_size)))
    return page.section("Files", page.links(entries) if entries else "")


def _footer(metrics: Metrics) -> str:
    version = lookup(metrics, "provenance", "version")[0] or ""
    words = (
        f"erfsfm-slam {version}. Axes: x right, y down, z ahead; the world is the first camera. ATE: root mean square "
        "of position errors. RPE: mean over consecutive frames. The raw network chain has no metric scale of its "
        "own: compare it under the alignments with scale."
    )
    return f"<footer>{page.text(words, 'soft')}</footer>"


def _trajectories(folder: RunFolder) -> dict[str, Trajectory]:
    """What there is to draw; a damaged or missing file must not cost the rest of the report."""
    try:
        return trajectories_of(folder)
    except SlamError as error:
        logger.warning("the report shows no trajectories: %s", error)
        return {}


def _drawn(draw: Callable[[], Figure], alternative: str, caption: str) -> str:
    """A picture, or why it cannot be drawn (trajectories that share no time, for one)."""
    try:
        return page.picture(draw(), alternative, caption)
    except SlamError as error:
        return page.text(f"{alternative}: not drawn, {error}.", "soft")


def _size(count: int) -> str:
    size = float(count)
    for unit in ("B", "kB", "MB"):
        if size < 1000.0:
            return f"{size:.3g} {unit}"
        size /= 1000.0
    return f"{size:.3g} GB"
