"""The map in the report: its size, and its error against the true surface, also by distance."""

from __future__ import annotations

from collections.abc import Sequence

from slam.evaluation.map import SurfaceMetrics
from slam.results.metrics import SIZES, Metrics
from slam.results.report.tables import Cell, Table, notes_on, number

_ERRORS = {
    "accuracy, median\u00a0(m)": "accuracy_median_m",
    "accuracy, 90\u00a0%\u00a0(m)": "accuracy_90_m",
    "over 1\u00a0m": "outlier_share",
    "completeness, 0.3\u00a0m": "completeness",
    "F-score, 0.2\u00a0m": "f_score.m02",
    "F-score, 0.5\u00a0m": "f_score.m05",
}
_FILTERS = {
    "unknown": "no depth",
    "border": "left, right and upper border of the image (mapping.border)",
    "bonnet": "lower border, the car's own hood (mapping.hood_crop)",
    "sky": "bright or blue above the horizon (mapping.sky_brightness, mapping.sky_blueness)",
    "range": "too near or too far (mapping.depth_min_m, mapping.depth_max_m, mapping.certain_range_factor)",
    "sigma": "refined depth too uncertain (mapping.max_relative_sigma)",
    "edge": "at a step of depth (mapping.max_depth_step)",
    "agreement": "the keyframe before does not agree (mapping.max_depth_difference)",
    "moving": "a keyframe before saw what is behind",
}
_TRUTHS = {
    "exact surface": "the exact surface of the simulated world",
    "depth maps": "depth maps accumulated at true poses",
    "lidar": "LiDAR scans accumulated at true poses, moving objects among them",
}


def map_sizes(metrics: Metrics) -> Table | None:
    """Every count of the map; None without one, and the reason alone where fusion was left out."""
    found = metrics.map
    if found.absent:
        return None
    if found.triangles is None:
        return Table((), [], notes=notes_on([f"map: {found.why('triangles')}"]))
    cells = {
        name.replace("_", " "): number(found, name)
        for name in SIZES
        if name in found.model_fields_set
        if isinstance(getattr(found, name), int) or name in ("points", "blocks")
    }
    missing = [f"{name}: {cell.tooltip}" for name, cell in cells.items() if cell.tooltip]
    return Table((), [[Cell(name), cell] for name, cell in cells.items()], "words", notes_on(missing))


def map_filters(metrics: Metrics) -> Table | None:
    """The share of pixels that each filter took before fusion, and what cleaning the mesh took; None without a map."""
    filters = metrics.map.filters
    if filters is None:
        return None
    rows: list[Sequence[Cell] | str] = [
        [Cell(name), Cell(f"{share:.1%}"), Cell(_FILTERS.get(name, ""))] for name, share in filters.items()
    ]
    rows.append([Cell("fused"), Cell(f"{1 - sum(filters.values()):.1%}"), Cell("what the filters left")])
    loose = "of the mesh: small loose pieces, left out (mapping.min_component_triangles)"
    double = "of the mesh's area: a parallel surface 0.3 to 2 m before it"
    for name, part, what in (
        ("floaters", metrics.map.floater_share, loose),
        ("double walls", metrics.map.double_wall_share, double),
    ):
        if part is not None:
            rows.append([Cell(name), Cell(f"{part:.1%}"), Cell(what)])
    return Table(["filter", "share", "of the keyframes' pixels, one filter after another"], rows, "words")


def map_errors_table(metrics: Metrics) -> Table | None:
    """Errors of the map under both alignments, and by distance from the camera; None without a map."""
    found = metrics.map
    if found.triangles is None:
        return None
    if found.truth is None:
        return Table((), [], notes=notes_on([f"error of the map: {found.why('truth')}"]))
    rows: list[Sequence[Cell] | str] = [_row("one rigid motion", found)]
    if found.in_field.share not in (None, 1.0):
        rows.append(_row("where the scanner looked", found.in_field))
    rows.append(_row("with one scale", found.with_scale))
    rings = _rings(metrics)
    if rings:
        is_rigid = found.by_distance is not None
        rows.append("By distance from the nearest camera" + ("" if is_rigid else ", with one scale"))
        rows += [_row(f"{ring.from_m:.0f} to {ring.to_m:.0f} m", ring) for ring in rings]
    length = number(found, "evaluated_m").text
    truth = _TRUTHS.get(found.truth, found.truth)
    words = f"Against {truth}, {length} m of road. Map where no surface was measured is an error."
    missing = (number(found, name).tooltip for name in _ERRORS.values())
    return Table(["", *_ERRORS], rows, notes=[words, *notes_on(missing)])


def _row(title: str, errors: SurfaceMetrics) -> list[Cell]:
    return [Cell(title), *(number(errors, name, 3) for name in _ERRORS.values())]


def _rings(metrics: Metrics) -> list[SurfaceMetrics]:
    """The curve of the rigidly moved map, or of the scaled one where lengths are not in metres."""
    rigid = metrics.map.by_distance
    return (metrics.map.with_scale.by_distance if rigid is None else rigid) or []
