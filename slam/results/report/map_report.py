"""The map in the report: its size, its error against the true surface, and the error over distance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from slam.results.comparison import lookup
from slam.results.report.plots import figure_style
from slam.results.report.tables import Cell, Metrics, Table, notes_on, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ERRORS: tuple[tuple[tuple[str, ...], str], ...] = (
    (("accuracy_median_m",), "accuracy, median (m)"),
    (("accuracy_90_m",), "accuracy, 90 % (m)"),
    (("outlier_share",), "over 1 m"),
    (("completeness",), "completeness, 0.3 m"),
    (("f_score", "0.2"), "F-score, 0.2 m"),
    (("f_score", "0.5"), "F-score, 0.5 m"),
)
_FILTERS = {
    "unknown": "no depth",
    "border": "left, right and upper border of the image (mapping.border)",
    "bonnet": "lower border, the car's own bonnet (mapping.bonnet)",
    "sky": "bright or blue above the horizon (mapping.sky_brightness, mapping.sky_blueness)",
    "range": "too near or too far (mapping.depth_min_m, mapping.depth_max_m, mapping.sure_reach)",
    "sigma": "refined depth too uncertain (mapping.max_relative_sigma)",
    "edge": "at a step of depth (mapping.max_depth_step)",
    "agreement": "the keyframe before does not agree (mapping.consistency)",
}
_TRUTHS = {
    "exact surface": "the exact surface of the simulated street",
    "depth maps": "depth maps accumulated at true poses",
    "lidar": "LiDAR scans accumulated at true poses, moving objects among them",
}


def map_sizes(metrics: Metrics) -> Table | None:
    """Every count of the map; None without one, and the reason alone where fusion was left out."""
    numbers, _ = lookup(metrics, "map")
    if numbers is None:
        return None
    if numbers.get("triangles") is None:
        return Table((), [], notes=notes_on([f"map: {lookup(numbers, 'triangles')[1]}"]))
    counted = ("triangles", "points", "blocks")
    keys = [key for key, value in numbers.items() if key in counted or isinstance(value, int)]
    names = [key.replace("_", " ") for key in keys]
    cells = [number(numbers, key) for key in keys]
    missing = [f"{name}: {cell.tooltip}" for name, cell in zip(names, cells) if cell.tooltip]
    return Table(["", *names], [[Cell("map"), *cells]], notes=notes_on(missing))


def map_filters(metrics: Metrics) -> Table | None:
    """The share of pixels that each filter took before fusion, and what cleaning the mesh took; None without a map."""
    filters, _ = lookup(metrics, "map", "filters")
    if filters is None:
        return None
    rows: list[Sequence[Cell] | str] = [
        [Cell(name), Cell(f"{share:.1%}"), Cell(_FILTERS.get(name, ""))] for name, share in filters.items()
    ]
    rows.append([Cell("fused"), Cell(f"{1 - sum(filters.values()):.1%}"), Cell("what the filters left")])
    for key, name, what in (
        ("floater_share", "floaters", "of the mesh: small loose pieces, left out (mapping.min_component_triangles)"),
        ("double_wall_share", "double walls", "of the mesh's area: a parallel surface 0.3 to 2 m before it"),
    ):
        share, _ = lookup(metrics, "map", key)
        if share is not None:
            rows.append([Cell(name), Cell(f"{share:.1%}"), Cell(what)])
    shares, _ = lookup(metrics, "map", "double_wall_share_at_loops")
    if shares is not None:
        what = "of the two submaps that most loops join: by the odometry, then at the poses of the map"
        rows.append([Cell("double walls there"), Cell(f"{shares['before']:.1%}, {shares['after']:.1%}"), Cell(what)])
    return Table(["filter", "share", "of the keyframes' pixels, one filter after another"], rows)


def map_errors_table(metrics: Metrics) -> Table | None:
    """Errors of the map under both alignments, and by distance from the camera; None without a map."""
    numbers, _ = lookup(metrics, "map")
    if numbers is None or numbers.get("triangles") is None:
        return None
    scaled, _ = lookup(numbers, "with_scale")
    truth, reason = lookup(numbers, "truth")
    if truth is None:
        return Table((), [], notes=notes_on([f"error of the map: {reason}"]))
    rows: list[Sequence[Cell] | str] = [_row("one rigid motion", numbers)]
    if lookup(numbers, "in_field", "share")[0] not in (None, 1.0):
        rows.append(_row("where the scanner looked", numbers["in_field"]))
    rows.append(_row("with one scale", scaled))
    bins = _bins(numbers)
    if bins:
        rows.append("By distance from the nearest camera" + ("" if _is_rigid(numbers) else ", with one scale"))
        rows += [_row(f"{ring['from_m']:.0f} to {ring['to_m']:.0f} m", ring) for ring in bins]
    length = number(numbers, "evaluated_m").text
    words = f"Against {_TRUTHS.get(truth, truth)}, {length} m of road. Map where no surface was measured is an error."
    missing = dict.fromkeys(lookup(numbers, *path)[1] for path, _ in _ERRORS)
    return Table(["", *(name for _, name in _ERRORS)], rows, notes=[words, *notes_on(missing)])


def map_error_figure(metrics: Metrics) -> Figure:
    """Accuracy, completeness and F-scores over the distance from the nearest camera."""
    bins = _bins(metrics["map"])
    with figure_style() as new_figure:
        figure = new_figure(figsize=(7.4, 3.0), layout="constrained")
        left, right = figure.subplots(1, 2)
        _draw(left, bins, (("accuracy_median_m",), "median"), color="#0072b2", linestyle="-")
        _draw(left, bins, (("accuracy_90_m",), "90 %"), color="#e69f00", linestyle="--")
        left.set(xlabel="distance from the camera (m)", ylabel="distance to the true surface (m)", yscale="log")
        left.yaxis.set_major_formatter("{x:g}")
        _draw(right, bins, (("completeness",), "completeness, 0.3 m"), color="#0072b2", linestyle="-")
        _draw(right, bins, (("f_score", "0.5"), "F-score, 0.5 m"), color="#e69f00", linestyle="--")
        _draw(right, bins, (("f_score", "0.2"), "F-score, 0.2 m"), color="#009e73", linestyle=":")
        right.set(xlabel="distance from the camera (m)", ylim=(0.0, 1.02))
        for axes in (left, right):
            axes.set_xlim(left=0)
            axes.legend()
    return figure


def has_map_curve(metrics: Metrics) -> bool:
    """Whether the error of the map is known at two distances or more."""
    numbers, _ = lookup(metrics, "map")
    known = [] if numbers is None else [ring for ring in _bins(numbers) if ring.get("accuracy_median_m") is not None]
    return len(known) > 1


def _draw(axes: Axes, bins: Sequence[Metrics], line: tuple[tuple[str, ...], str], **look: Any) -> None:
    path, label = line
    values = [(0.5 * (ring["from_m"] + ring["to_m"]), lookup(ring, *path)[0]) for ring in bins]
    known = [(middle, value) for middle, value in values if value is not None]
    axes.plot([middle for middle, _ in known], [value for _, value in known], marker="o", label=label, **look)


def _row(name: str, numbers: Mapping[str, Any] | None) -> list[Cell]:
    return [Cell(name), *(number(numbers or {}, *path, decimals=3) for path, _ in _ERRORS)]


def _is_rigid(numbers: Mapping[str, Any]) -> bool:
    return lookup(numbers, "by_distance")[0] is not None


def _bins(numbers: Mapping[str, Any]) -> list[Metrics]:
    """The curve of the rigidly moved map, or of the scaled one where lengths are not in metres."""
    found, _ = lookup(numbers, "by_distance") if _is_rigid(numbers) else lookup(numbers, "with_scale", "by_distance")
    return list(found or [])
