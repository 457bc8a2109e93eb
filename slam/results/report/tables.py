"""The tables of a report, from ``metrics.json``; rows that say nothing are left out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from erfsfm.common.table import DASH, Table
from slam.evaluation.map import SurfaceMetrics
from slam.results.folder import RunFolder
from slam.results.metrics import CAMERA_HEIGHTS, METRES, GpsErrors, Metrics, Stretch
from slam.results.tables import written
from slam.runtime.run_files import MEANINGS, REPORT
from slam.runtime.storage.record import NOT_RECORDED

_MOST = 12  # of one kind
_LEAST_SHARE = 0.0005  # that a table of percent shows
_MAP_ERRORS = {
    "accuracy\nmedian, m": "accuracy_median_m",
    "accuracy\n90 %, m": "accuracy_90_m",
    "over 1 m": "outlier_share",
    "completeness\n0.3 m": "completeness",
    "F-score\n0.2 m": "f_score.m02",
    "F-score\n0.5 m": "f_score.m05",
}
_FILTERS = {
    "unknown": "no depth",
    "border": "left, right and upper border of the image",
    "bonnet": "lower border, the car's own hood (mapping.hood_crop)",
    "sky": "bright or blue above the horizon",
    "range": "too near or too far (mapping.depth_min_m, mapping.depth_max_m)",
    "sigma": "refined depth too uncertain (mapping.max_relative_sigma)",
    "edge": "at a step of depth",
    "agreement": "the keyframe before does not agree",
    "moving": "a keyframe before saw what is behind",
}
_TRUTHS = {
    "exact surface": "the exact surface of the simulated world",
    "depth maps": "depth maps accumulated at true poses",
    "lidar": "LiDAR scans accumulated at true poses, moving objects among them",
}


def number(value: Any, decimals: int = 0) -> str:
    """A value of the metrics, a dash where it is missing."""
    return f"{value:,}" if isinstance(value, int) else written(value, decimals)


def key_numbers(metrics: Metrics, has_map: bool) -> list[tuple[str, str, str]]:
    """The key numbers that there are: name, value and unit of each; of the map where it is one."""
    best = metrics.trajectories.optimised.align
    error = (best.dof6, "m, 6 dof") if metrics.is_metric else (best.dof7, "m, 7 dof")
    wanted = [
        ("Position error", error[0].ate_rmse_m, 2, error[1]),
        ("Drift, t_rel", best.dof7.t_rel_percent, 2, "%"),
        ("Path", metrics.sequence.length_m, 0, "m"),
        ("Frames", metrics.sequence.frames, 0, ""),
        ("Speed", metrics.timing.frames_per_second, 1, "frames/s"),
        ("Loops accepted", metrics.loops.accepted, 0, ""),
        ("Map triangles", metrics.map.triangles if has_map else None, 0, ""),
    ]
    return [(name, number(value, decimals), unit) for name, value, decimals, unit in wanted if value is not None]


def what_ran(metrics: Metrics) -> Table:
    """Sequence, weights, scale and command; a run that failed early has fewer rows."""

    def text(path: str, decimals: int = 1, unit: str = "", most: int | None = None) -> str:
        value, reason = metrics.at(path)
        return f"{DASH} ({reason})" if value is None else f"{written(value, decimals)[:most]}{unit}"

    sequence, ran = metrics.sequence, metrics.provenance
    leak = {True: "yes: trained on this sequence", False: "none known", None: DASH}[ran.leak]
    rate = text("sequence.fps", unit=" a second")
    rows = [
        ("Sequence", f"{text('sequence.name')}, {text('sequence.frames')} frames, {rate}"),
        ("Interpolated frames", "; ".join(by_reason(sequence.bridged or ()))),
        ("Doubled frames", "; ".join(by_reason(sequence.doubled or ()))),
        ("LiDAR scans left out", "; ".join(by_reason(sequence.unreadable_scans or ()))),
        ("Scale", _scale(metrics)),
        ("Weights", f"{text('provenance.weights')}, sha256 {text('provenance.weights_sha256', most=16)}"),
        ("Depth", _depth_source(metrics)),
        ("Licence of the weights", text("provenance.weights_licence")),
        ("Trained on", _shortened(ran.trained_on or ()) or DASH),
        ("Leak", leak),
        ("Command", text("provenance.command")),
        ("Seed, device", f"{text('provenance.seed')}, {text('provenance.device')}"),
        ("Version, commit", f"{text('provenance.version')}, {text('provenance.commit')}"),
    ]
    told = [row for row in rows if row[1] and not (metrics.failure and NOT_RECORDED in row[1])]
    return Table((), told, names=2)


def by_reason(found: Iterable[Stretch]) -> list[str]:
    """For each reason the frames that it is about, such as ``frames 3, 7 to 9: reason``."""
    frames: dict[str, list[str]] = {}
    for each in found:
        ends = str(each.first) if each.first == each.last else f"{each.first} to {each.last}"
        frames.setdefault(each.reason, []).append(ends)
    return [f"frames {_shortened(ends)}: {reason}" for reason, ends in frames.items()]


def gps(metrics: Metrics) -> Table | None:
    """Distances from the GPS track; None without one."""
    found = metrics.gps
    if found.absent:
        return None

    def row(name: str, errors: GpsErrors) -> list[str]:
        values = (errors.horizontal_rmse_m, errors.horizontal_median_m, errors.vertical_rmse_m)
        return [name, *(number(value, 2) for value in values)]

    factors = "which are factors of the pose graph: the optimised row is no independent test"
    use = factors if found.in_graph is True else "not in the pose graph"
    notes = [f"{found.fixes} fixes, {use}. Both trajectories are turned and moved onto the track, not scaled."]
    head = ("", "horizontal\nRMSE, m", "horizontal\nmedian, m", "vertical\nRMSE, m")
    return Table(head, [row("odometry", found.odometry), row("optimised", found.optimised)], notes=notes)


def loop_counts(metrics: Metrics) -> str:
    """How far loops came, in one sentence; empty where nothing is known of them."""
    found = metrics.loops
    if found.absent:
        return ""
    stages = {"candidates": "candidates", "verified": "measured", "accepted": "accepted"}
    reasons = {reason: None for value, reason in map(found.at, stages) if value is None}
    counts = ", ".join(f"{number(found.at(name)[0])} {word}" for name, word in stages.items())
    return f"{counts}{''.join(f'; {reason}' for reason in reasons)}. All are in loops.json."


def depth_error(metrics: Metrics) -> Table | None:
    """Error of learned depth over distance; None where it was not measured."""
    rows = [
        [
            number(row.depth, 1),
            DASH if row.bias is None else f"{100 * row.bias:+.0f} %",
            DASH if row.sigma is None else f"{100 * row.sigma:.0f} %",
            number(row.corners),
        ]
        for row in metrics.depth_error or ()
    ]
    note = (
        "Learned depth against depth triangulated from the images. Its mean error (bias) is taken out before it is "
        "compared with image geometry."
    )
    return Table(("learned depth", "bias", "spread", "corners"), rows, notes=[note]) if rows else None


def map_left_out(metrics: Metrics) -> Table | None:
    """The share of pixels that each filter took before fusion, and what cleaning the mesh took; None without a map."""
    filters = metrics.map.filters
    if filters is None:
        return None
    shares = {name: (share, _FILTERS.get(name, "")) for name, share in filters.items()}
    shares["fused"] = (1.0 - sum(filters.values()), "what the filters left")
    loose = "of the mesh: small loose pieces, left out"
    double = "of the mesh's area: a parallel surface 0.3 to 2 m before it"
    for name, part, what in (
        ("floaters", metrics.map.floater_share, loose),
        ("double walls", metrics.map.double_wall_share, double),
    ):
        shares[name] = (part or 0.0, what)
    rows = [[name, f"{share:.1%}", what] for name, (share, what) in shares.items() if share >= _LEAST_SHARE]
    side = f"{number(metrics.map.voxel_size, 2)} {'m' if metrics.is_metric else 'units'}"
    note = f"{number(metrics.map.frames_fused)} keyframes, voxels of {side}."
    return Table(("", "share", "of the keyframes' pixels, one filter after another"), rows, notes=[note], names=3)


def map_errors(metrics: Metrics) -> Table | None:
    """Errors of the map under both alignments, and by distance from the camera; None without a map."""
    found = metrics.map
    if found.triangles is None:
        return None
    if found.truth is None:
        return Table((), (), notes=[f"No error of the map: {found.why('truth')}."])
    rows: dict[str, SurfaceMetrics] = {"one rigid motion": found} if metrics.is_metric else {}
    if found.in_field.share not in (None, 1.0):
        rows["where the scanner looked"] = found.in_field
    rows["with one scale"] = found.with_scale
    rings = found.with_scale.by_distance if found.by_distance is None else found.by_distance
    rows |= {f"{ring.from_m:.0f} to {ring.to_m:.0f} m from the camera": ring for ring in rings or ()}
    texts = [[name, *(number(each.at(path)[0], 3) for path in _MAP_ERRORS.values())] for name, each in rows.items()]
    truth, length = _TRUTHS.get(found.truth, found.truth), number(found.evaluated_m)
    note = f"Against {truth}, {length} m of the path. Map where no surface was measured is an error."
    return Table(("", *_MAP_ERRORS), texts, notes=[note])


def timing(metrics: Metrics) -> Table | None:
    """Seconds by stage, the longest first; None where nothing was timed."""
    stages = metrics.timing.stages
    if not stages:
        return None
    timed = sum(stages.values())
    total = max(metrics.timing.seconds_total or 0.0, timed, 1e-9)
    ordered = sorted((stages | {"between stages": total - timed}).items(), key=lambda item: -item[1])
    rows = [[name, f"{seconds:.1f}", f"{seconds / total:.0%}"] for name, seconds in ordered if seconds >= 0.005 * total]
    memory, processor = (number(each) for each in (metrics.timing.peak_rss_mb, metrics.timing.cpu_seconds))
    note = f"{total:.1f} s in all, {processor} s of processor time, at most {memory} MiB of memory."
    return Table(("stage", "seconds", "share"), rows, notes=[note])


def files(folder: RunFolder) -> Table | None:
    """Every other file of the run with its meaning and size."""
    rows = [
        [
            Markup('<a href="{}"><code>{}</code></a>').format(quote(path.name), path.name),
            MEANINGS.get(path.name, ""),
            _size(path.stat().st_size),
        ]
        for path in sorted(folder.path.iterdir())
        if path.is_file() and not path.name.startswith(".") and path.name != REPORT
    ]
    return Table((), rows, names=2) if rows else None


def _scale(metrics: Metrics) -> str:
    scale = metrics.scale
    if scale.value is None:
        return f"mode {scale.mode or DASH}, {scale.why('value')}"
    spread, frames = scale.spread, scale.frames_used
    unit = metrics.unit if metrics.unit in (METRES, CAMERA_HEIGHTS) else "units of the result"
    certain = "" if spread is None else f", spread {100 * spread:.1f} %"
    used = "" if frames is None else f", measured in {frames} frames"
    return f"mode {scale.mode}: one unit of the networks is {scale.value:.4g} {unit}{certain}{used}"


def _depth_source(metrics: Metrics) -> str:
    name = metrics.provenance.depth_source
    if name is None:
        return f"{DASH} ({metrics.provenance.why('depth_source')})"
    sha256 = metrics.provenance.depth_sha256
    return "by these weights" if name == "network" else f"{name}, sha256 {str(sha256)[:16]}"


def _shortened(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST} more" if len(names) > _MOST else ""
    return ", ".join(names[:_MOST]) + more


def _size(count: int) -> str:
    size = float(count)
    for unit in ("B", "kB", "MB"):
        if size < 1000.0:
            return f"{size:.3g} {unit}"
        size /= 1000.0
    return f"{size:.3g} GB"
