"""The report of a run: one page that opens offline and asks for nothing, with verdict, errors, figures and inputs.

Its images are the depth of some keyframes, and accepted loops with corners that both images show.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import cycle
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from numpy.typing import NDArray

from erfsfm.common.readers.images import resize_image
from slam.formats.trajectory import Trajectory
from slam.frames import Image, Intrinsics, Mask, resized_mask
from slam.loops.verification import Loop
from slam.mapping.depth import KeyframeDepth
from slam.results.folder import RunFolder
from slam.results.metrics import METRES, AcceptedLoop, LoopsFile, Metrics
from slam.results.report import tables
from slam.results.tables import alignments_table, errors_table, missing_errors
from slam.results.verdict import verdict
from slam.runtime.files import LOOPS, REFERENCE, REPORT, TRAJECTORIES
from slam.runtime.record import NOT_RECORDED

if TYPE_CHECKING:  # Plotly is for runs with a report, and for their end
    from plotly.graph_objects import Figure

    from slam.results.report.figures import MapView

_ALIGNED = "Each estimate is aligned to the ground truth by rotation, translation and one scale."
_AS_WRITTEN = "As written; no ground truth is known. The network trajectory is scaled to the rest."
_TEMPLATES = Environment(
    loader=PackageLoader("slam", "results/report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_EXAMPLES, _MOST_LOOPS, _MOST_LINES = 5, 6, 60
_WIDTH_PX = 480
_LEAST_FIXED, _RED = 0.02, (220, 30, 30)  # of the image; its colour there
_LINES = ((0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (213, 94, 0))


@dataclass(frozen=True)
class Picture:
    """An image by its address, or a plot as Plotly's JSON."""

    title: str
    caption: str
    image: str = ""
    plot: str = ""


def write_report(
    folder: RunFolder,
    depths: Sequence[Picture] = (),
    loops: Sequence[Picture] = (),
    view: MapView | None = None,
    metrics: Metrics | None = None,
    fixed: Sequence[Picture] = (),
) -> None:
    """Write ``report.html`` from the files of a run, also of a failed one, and what they do not hold.

    ``depths`` are strips of images and their depth, ``loops`` pairs of images of accepted loops, ``fixed`` shows the
    part of the image that is fixed to the camera; without ``metrics`` those of the folder are read.
    """
    metrics = metrics or folder.metrics()
    said, errors = verdict(metrics), metrics.evaluated_errors()
    no_errors, optimised = missing_errors(errors), metrics.trajectories.optimised
    found = {name: folder.trajectory(name) for name in (REFERENCE, *TRAJECTORIES)}
    drawn = {name: trajectory for name, trajectory in found.items() if trajectory is not None}
    accepted = (
        LoopsFile.read(folder.path / LOOPS).accepted or []
        if (folder.path / LOOPS).is_file()
        else []
    )
    no_map = "" if metrics.map.triangles is not None else metrics.map.why("triangles")
    page = _TEMPLATES.get_template("page.html.j2").render(
        script=(files("slam.results.report") / "page.js").read_text("utf-8"),
        plotly=_plotly,
        tables=tables,
        folder=folder,
        metrics=metrics,
        verdict=said,
        plots=_plots(metrics, drawn, accepted, view),
        errors=errors_table(errors) if errors and not no_errors else None,
        alignments=alignments_table(optimised) if not optimised.absent and not no_errors else None,
        no_errors=no_errors,
        depths=depths,
        fixed=fixed,
        no_map=_absence(metrics, no_map),
        loop_pictures=loops,
        no_loops=_absence(metrics, metrics.loops.absent),
    )
    folder.write(REPORT, page)


def _absence(metrics: Metrics, reason: str) -> str:
    """Why a run has no such part; empty where it has one, or failed before."""
    return "" if metrics.failure and reason == NOT_RECORDED else reason


def _plots(
    metrics: Metrics,
    trajectories: Mapping[str, Trajectory],
    loops: Sequence[AcceptedLoop],
    view: MapView | None,
) -> dict[str, list[Picture]]:
    """The plots of every section."""
    from slam.results.report import figures

    found: dict[str, list[Picture]] = {"trajectories": [], "errors": [], "map": []}
    has_truth = REFERENCE in trajectories and len(trajectories) > 1
    if trajectories:
        found["trajectories"] = _trajectory_plots(metrics, trajectories, loops, has_truth)
    if has_truth:
        caption = "Distance to the true position, after the 7-dof alignment."
        title = "Position error along the path"
        found["errors"].append(_plot(title, caption, figures.error_figure, trajectories))
        if metrics.trajectories.optimised.align.dof7.t_rel_percent is not None:
            caption = "Mean relative error of all segments of a length; the scale is that of the 7-dof alignment."
            title = "Drift by the length of segments"
            found["errors"].append(_plot(title, caption, figures.drift_figure, trajectories))
    if view is not None:
        caption = (
            f"The map, thinned, and the camera's path, seen first from its place at frame {view.frame}. "
            "Drag to turn it, with the right button to move it; the wheel zooms."
        )
        found["map"] = [_plot("Map", caption, figures.map_figure, view)]
    return found


def _trajectory_plots(
    metrics: Metrics,
    trajectories: Mapping[str, Trajectory],
    loops: Sequence[AcceptedLoop],
    has_truth: bool,
) -> list[Picture]:
    """The paths from above, and over time their scale and rotation, or without a truth their speed."""
    from slam.results.report import figures

    unit = "m" if metrics.unit == METRES or has_truth else metrics.unit
    caption = _ALIGNED if has_truth else _AS_WRITTEN
    draw = figures.trajectories_figure
    above = _plot("Trajectories from above", caption, draw, trajectories, unit, loops)
    gaps = metrics.sequence.bridged or []
    if not has_truth:
        title = "Speed and rotation over time"
        caption = (
            "Speed, and the angles of the optimised trajectory. Interpolated frames are shaded."
        )
        return [above, _plot(title, caption, figures.motion_figure, trajectories, unit, gaps)]
    title = "Scale and rotation over time"
    how = (
        "as written, the network after the 7-dof alignment"
        if metrics.is_metric
        else "after the 7-dof alignment"
    )
    caption = f"Lengths of stretches of 1/25 of the path, {how}; rotation after it. Interpolated frames are shaded."
    is_metric = metrics.is_metric
    return [above, _plot(title, caption, figures.scale_figure, trajectories, is_metric, gaps)]


def _plot(title: str, caption: str, draw: Callable[..., Figure], *given: Any) -> Picture:
    """What ``draw`` makes of what is given."""
    figure = draw(*given).update_layout(template={})  # page.js draws it in the page's colours
    return Picture(title, caption, plot=str(figure.to_json()).replace("<", "\\u003c"))


@cache
def _plotly() -> str:
    """The library as base64 of gzip, which ``unpacked`` of page.js reads."""
    from plotly.offline import get_plotlyjs

    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), 6, mtime=0)).decode("ascii")


class DepthPictures:
    """Keeps keyframes evenly spread over a drive while the map is fused: the first from each of five places on."""

    def __init__(self, frames: int) -> None:
        """``frames`` of the drive."""
        self._places = np.linspace(0, frames, _EXAMPLES + 2)[1:-1].tolist()
        self._kept: list[KeyframeDepth] = []

    def add(self, keyframe: KeyframeDepth) -> None:
        """Offer the next keyframe."""
        if self._places and keyframe.frame >= self._places[0]:
            self._kept.append(keyframe)
            self._places = [place for place in self._places if place > keyframe.frame]

    def pictures(self) -> list[Picture]:
        """A strip each: the image, learned depth and refined depth, near in yellow, in one colour scale."""
        from erfsfm.inference import colour_disparity

        found = []
        for each in self._kept:
            learned = each.depth if each.network_depth is None else each.network_depth
            depths = [learned] if each.relative_sigma is None else [learned, each.depth]
            strip = np.hstack([each.image, colour_disparity(np.hstack(depths))])
            found.append(
                _picture(narrowed(strip, _WIDTH_PX * (1 + len(depths))), f"Frame {each.frame}")
            )
        return found


def loop_pictures(
    loops: Sequence[Loop], image: Callable[[int], Image | None], intrinsics: Intrinsics
) -> list[Picture]:
    """Some accepted loops, spread over the drive: both images with lines between the corners that measured the loop.

    Loops of which an image is None, as those of a live drive are, are left out; ``intrinsics`` are of the recording,
    images may be smaller.
    """
    found = []
    ordered = sorted(loops, key=lambda loop: loop.ends[::-1])
    for some in np.array_split(np.arange(len(ordered)), min(_MOST_LOOPS, len(ordered)) or 1):
        best = max((ordered[k] for k in some), key=lambda loop: loop.inliers, default=None)
        if best is not None:
            first, second = (image(index) for index in best.ends)
            if first is not None and second is not None:
                title = f"Frames {best.ends[0]} and {best.ends[1]}: {best.inliers} inliers"
                found.append(
                    _picture(
                        _joined(first, second, best.pixels * (_WIDTH_PX / intrinsics.width)), title
                    )
                )
    return found


def fixed_pictures(image: Image, fixed: Mask) -> list[Picture]:
    """An image ``(H, W, 3)`` with the part ``(h, w)`` of it that is fixed to the camera in red; none if it is small."""
    if fixed.mean() < _LEAST_FIXED:
        return []
    image = narrowed(image, _WIDTH_PX)
    red = resized_mask(fixed, *image.shape[1::-1])
    image[red] = image[red] // 2 + np.array(_RED, np.uint8) // 2
    return [_picture(image, f"{100 * fixed.mean():.0f} % of the image")]


def _joined(first: Image, second: Image, ends: NDArray[np.floating]) -> Image:
    """Both images, wide ones below each other, with a line for every corner ``(M, 2, 2)``, some of very many."""
    wide = first.shape[1] > 2 * first.shape[0]
    left, right = narrowed(first, _WIDTH_PX), narrowed(second, _WIDTH_PX)
    joined = np.ascontiguousarray(np.vstack([left, right]) if wide else np.hstack([left, right]))
    shift = np.array([[0, 0], [0, left.shape[0]] if wide else [_WIDTH_PX, 0]])
    ends = (ends + shift)[:: max(1, -(-len(ends) // _MOST_LINES))]
    for (start, end), colour in zip(np.rint(ends).astype(int).tolist(), cycle(_LINES)):
        cv2.line(joined, start, end, colour, 1, cv2.LINE_AA)
        for place in (start, end):
            cv2.circle(joined, place, 2, colour, 1, cv2.LINE_AA)
    return joined


def narrowed(image: Image, width: int) -> Image:
    """An image at another width."""
    return resize_image(image, max(round(image.shape[0] * width / image.shape[1]), 1), width)


def _picture(image: Image, title: str) -> Picture:
    _, content = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
    return Picture(
        title,
        title,
        f"data:image/jpeg;base64,{base64.b64encode(content.tobytes()).decode('ascii')}",
    )
