"""The tables of a report, by ``metrics.json``, without rows that say nothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from erfsfm.common.table import Table
from slam.evaluation.map import SurfaceMetrics
from slam.frontend.measured import named
from slam.results.metrics import CAMERA_HEIGHTS, METRES, Metrics, Stretch
from slam.results.tables import motion_line, written
from slam.runtime.files import MEANINGS, REPORT

_MOST = 12  # of one kind
_LEAST_SHARE = 0.005  # of the whole, that a table shows
_MAP_ERRORS = {
    "accuracy\nmedian, m": "accuracy_median_m",
    "accuracy\n90 %, m": "accuracy_90_m",
    "over 1 m": "outlier_share",
    "completeness\n0.3 m": "completeness",
    "F-score\n0.2 m": "f_score.m02",
    "F-score\n0.5 m": "f_score.m05",
}
_ALIGN = "trajectories.optimised.align"
# name, path in the metrics, decimals and unit; the last is of the map
_TILES = (
    ("Path", "sequence.length_m", 0, "m"),
    ("Frames", "sequence.frames", 0, ""),
    ("Processing", "timing.frames_per_second", 1, "frames/s"),
    ("Loops accepted", "loops.accepted", 0, ""),
    ("Map triangles", "map.triangles", 0, ""),
)
_TRUTHS = {
    "exact surface": "the exact surface of the simulated world",
    "depth maps": "depth maps accumulated at true poses",
    "lidar": "LiDAR scans accumulated at true poses, moving objects among them",
}


def number(value: Any, decimals: int = 0) -> str:
    """A value of the metrics, a dash where it is missing."""
    return f"{value:,}" if isinstance(value, int) else written(value, decimals)


def key_numbers(metrics: Metrics, has_map: bool) -> list[tuple[str, str, str]]:
    """The key numbers that there are: name, value and unit of each; of the map where it is more than scraps."""
    dof = 6 if metrics.is_metric else 7
    tiles = [
        ("Position error", f"{_ALIGN}.{dof}dof.ate_rmse_m", 2, f"m, {dof} dof"),
        ("Drift, t_rel", f"{_ALIGN}.7dof.t_rel_percent", 2, "%"),
        *_TILES[: None if has_map else -1],
    ]
    found = []
    for name, path, decimals, unit in tiles:
        if (value := metrics.at(path)[0]) is not None:
            found.append((name, number(value, decimals), unit))
    return found


def what_ran(metrics: Metrics) -> Table:
    """Sequence, weights, scale and command, as far as they are known."""
    sequence, ran = metrics.sequence, metrics.provenance
    frames = sequence.frames and f"{sequence.frames} frames"
    rate = sequence.fps and f"{sequence.fps:.1f} a second"
    shas = [sha and f"sha256 {sha[:16]}" for sha in (ran.weights_sha256, ran.depth_sha256)]
    rows = [
        ("Sequence", _joined(sequence.name, frames, rate)),
        ("Estimated path", motion_line(metrics)),
        ("Interpolated frames", "; ".join(by_reason(sequence.bridged or ()))),
        ("Doubled frames", "; ".join(by_reason(sequence.doubled or ()))),
        ("LiDAR scans left out", "; ".join(by_reason(sequence.unreadable_scans or ()))),
        ("Scale", _scale(metrics)),
        ("Weights", _joined(ran.weights, shas[0])),
        ("Depth", "" if ran.depth_source == "network" else _joined(ran.depth_source, shas[1])),
        ("Licence of the weights", ran.weights_licence),
        ("Trained on", _shortened(ran.trained_on or ())),
        ("Leak", {True: "yes: trained on this sequence", False: "none known", None: ""}[ran.leak]),
        ("Command", ran.command),
        ("Seed, device", _joined(ran.seed, ran.device)),
        ("Version, commit", _joined(ran.version, ran.commit)),
    ]
    return Table((), [(name, text) for name, text in rows if text], names=2)


def loop_counts(metrics: Metrics) -> str:
    """How far loops came, in one sentence; empty where nothing is known of them."""
    found = metrics.loops
    if found.absent:
        return ""
    stages = {"candidates": "candidates", "verified": "measured", "accepted": "accepted"}
    reasons = {reason: None for value, reason in map(found.at, stages) if value is None}
    counts = ", ".join(f"{number(found.at(name)[0])} {word}" for name, word in stages.items())
    return f"{counts}{''.join(f'; {reason}' for reason in reasons)}. All are in loops.json."


def map_errors(metrics: Metrics) -> Table | None:
    """Errors of the map under both alignments, and by distance from the camera; None without a map."""
    found = metrics.map
    if found.triangles is None:
        return None
    fused = f"{number(found.frames_fused)} keyframes were fused."
    if found.truth is None:
        return Table((), (), notes=[fused, f"No error of the map: {found.why('truth')}."])
    rows: dict[str, SurfaceMetrics] = {"one rigid motion": found} if metrics.is_metric else {}
    if found.in_field.share not in (None, 1.0):
        rows["where the scanner looked"] = found.in_field
    rows["with one scale"] = found.with_scale
    rings = found.with_scale.by_distance if found.by_distance is None else found.by_distance
    for ring in rings or ():
        rows[f"{ring.from_m:.0f} to {ring.to_m:.0f} m from the camera"] = ring
    texts = [
        [name, *(number(each.at(path)[0], 3) for path in _MAP_ERRORS.values())]
        for name, each in rows.items()
    ]
    truth, length = _TRUTHS.get(found.truth, found.truth), number(found.evaluated_m)
    note = (
        f"Against {truth}, {length} m of the path. Map where no surface was measured is an error."
    )
    return Table(("", *_MAP_ERRORS), texts, notes=[f"{note} {fused}"])


def timing(metrics: Metrics) -> Table | None:
    """Seconds by stage, the longest first; None where nothing was timed."""
    stages = metrics.timing.stages
    if not stages:
        return None
    timed = sum(stages.values())
    total = max(metrics.timing.seconds_total or 0.0, timed, 1e-9)
    spent = stages | {"between stages": total - timed}
    longest = sorted(spent.items(), key=lambda item: -item[1])
    rows = [
        [name, f"{seconds:.1f}", f"{seconds / total:.0%}"]
        for name, seconds in longest
        if seconds >= _LEAST_SHARE * total
    ]
    memory = number(metrics.timing.peak_rss_mb)
    processor = number(metrics.timing.cpu_seconds)
    note = f"{total:.1f} s in all, {processor} s of processor time, at most {memory} MiB of memory."
    return Table(("stage", "seconds", "share"), rows, notes=[note])


def files(folder: Path) -> Table | None:
    """Every other file of the run with its meaning and size."""
    rows = []
    for path in sorted(folder.iterdir()):
        if not path.is_file() or path.name.startswith(".") or path.name == REPORT:
            continue
        link = Markup('<a href="{}"><code>{}</code></a>').format(quote(path.name), path.name)
        size = f"{max(path.stat().st_size / 1000, 1):,.0f} kB"
        rows.append([link, MEANINGS.get(path.name, ""), size])
    return Table((), rows, names=2) if rows else None


def _joined(*parts: object) -> str:
    return ", ".join(str(each) for each in parts if each not in (None, ""))


def _scale(metrics: Metrics) -> str:
    scale = metrics.scale
    if scale.value is None:
        return f"mode {scale.mode}, {scale.why('value')}" if scale.mode else ""
    unit = metrics.unit if metrics.unit in (METRES, CAMERA_HEIGHTS) else "units of the result"
    certain = "" if scale.spread is None else f", spread {100 * scale.spread:.1f} %"
    used = "" if scale.frames_used is None else f", measured in {scale.frames_used} frames"
    return f"mode {scale.mode}: one unit of the networks is {scale.value:.4g} {unit}{certain}{used}"


def by_reason(found: Iterable[Stretch]) -> list[str]:
    """For each reason the frames that it is about, such as ``frames 3, 7 to 9: reason``."""
    frames: dict[str, list[int]] = {}
    for each in found:
        frames.setdefault(each.reason, []).extend(range(each.first, each.last + 1))
    return [f"frames {named(numbers)}: {reason}" for reason, numbers in frames.items()]


def _shortened(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST} more" if len(names) > _MOST else ""
    return ", ".join(names[:_MOST]) + more
