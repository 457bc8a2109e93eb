"""A run in tables and words, by its ``metrics.json``.

Errors of trajectories: of one run, of two files under every alignment, of several runs side by side. The tables of a
report, without rows that say nothing. How good a run is in one sentence, what speaks for it and what raises doubt.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from markupsafe import Markup

from erfsfm.common.table import DASH, Table
from slam.evaluation.map import SurfaceMetrics
from slam.evaluation.trajectory import ALIGNMENTS, AlignedMetrics, TrajectoryMetrics
from slam.frontend.agreement import DOUBTFUL
from slam.results.metrics import CAMERA_HEIGHTS, METRES, Metrics, Stretch
from slam.runtime.files import MEANINGS, REPORT

UNITS = "ATE: RMSE, m; of snippets of five frames, each with its own scale, norm / 5. RE: rad. t_rel, r_rel: 7 dof."
_LEAK = "LEAK: the weights were trained on the sequence; the numbers are no test."
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
_TRUTHS = {
    "exact surface": "the exact surface of the simulated world",
    "depth maps": "depth maps accumulated at true poses",
    "lidar": "LiDAR scans accumulated at true poses, moving objects among them",
}
_FROM = {
    "camera-height": "the camera's height over the road",
    "lidar": "LiDAR",
    "gps": "GPS",
    "known": "a known distance",
    "reference": "the truth itself, so that it is no result",
}
_WIDE_SPREAD = 0.15  # of the scale
_LARGEST_SCALE_ERROR = 0.03
_SURE = 0.5
_NOISE_POINTS = 0.12  # share of factors off the promised one
_LEAST_FUSED = 0.15  # of the depth of all keyframes: maps of streets and rooms have 0.35 to 0.6


class ErrorColumn(NamedTuple):
    """One number of a trajectory in the tables: its header, its path in the record and its decimals."""

    name: str
    path: str
    decimals: int


COLUMNS = (
    ErrorColumn("snippet\nATE", "snippet5.ate_mean", 4),
    ErrorColumn("snippet\nRE", "snippet5.re_mean", 4),
    ErrorColumn("ATE\n7dof", "align.7dof.ate_rmse_m", 3),
    ErrorColumn("ATE\n6dof", "align.6dof.ate_rmse_m", 3),
    ErrorColumn("t_rel\n%", "align.7dof.t_rel_percent", 2),
    ErrorColumn("r_rel\ndeg/100m", "align.7dof.r_rel_deg_per_100m", 3),
)


def written(value: Any, decimals: int) -> str:
    """A number with its decimals, tiny ones in powers of ten; a dash for a missing one."""
    if value is None:
        return DASH
    if not isinstance(value, float):
        return str(value)
    tiny = value != 0 and abs(value) < 0.5 * 10.0**-decimals
    return f"{value:.1e}" if tiny else f"{value:.{decimals}f}"


def errors_table(trajectories: Mapping[str, TrajectoryMetrics], title: str = "") -> Table:
    """The main errors, a row for each trajectory; below, the reasons of missing numbers, and whether evo agrees."""
    rows = [[name, *_numbers(errors)] for name, errors in trajectories.items()]
    found = [off for errors in trajectories.values() if (off := errors.evo.difference) is not None]
    evo = [f"evo gives the same numbers, to {max(found):.0e}."] if found else []
    notes = [UNITS, *evo, *missing_notes(trajectories)]
    return Table(["trajectory", *(column.name for column in COLUMNS)], rows, title, notes)


def alignments_table(errors: TrajectoryMetrics, title: str = "") -> Table:
    """Every statistic of one trajectory under every alignment, and its snippets below."""
    statistics = AlignedMetrics.statistics()
    values = {how: [errors.at(f"align.{how}.{key}") for key in statistics] for how in ALIGNMENTS}
    rows = [
        [
            how,
            *(written(value, each.decimals) for (value, _), each in zip(row, statistics.values())),
        ]
        for how, row in values.items()
    ]
    missing = {reason: None for row in values.values() for value, reason in row if value is None}
    snippets, evo = errors.snippet5, errors.evo
    notes = [
        f"Snippets of five frames: ATE {written(snippets.ate_mean, 4)} ± {written(snippets.ate_std, 4)} m, RE "
        f"{written(snippets.re_mean, 4)} ± {written(snippets.re_std, 4)} rad, {written(snippets.count, 0)} of them.",
        f"evo: APE {written(evo.ape_rmse_m_7dof, 3)} m at 7 dof, RPE {written(evo.rpe_trans_m, 4)} m and "
        f"{written(evo.rpe_rot_deg, 4)} deg; largest difference to ours {written(evo.difference, 1)}.",
        *(f"{DASH} {reason}." for reason in missing),
    ]
    return Table(["alignment", *(each.header for each in statistics.values())], rows, title, notes)


def runs_table(runs: Sequence[tuple[Path, Metrics]]) -> Table:
    """One row for each run and trajectory; runs that failed or were killed with the reason."""
    rows: list[list[str]] = []
    notes: dict[str, None] = {UNITS: None}
    names = [path.resolve().name for path, _ in runs]
    for (path, metrics), short in zip(runs, names, strict=True):
        title = name = str(path) if names.count(short) > 1 else short
        errors = metrics.evaluated_errors()
        if metrics.failure:
            ended = "failed" if metrics.status == "failed" else "did not end"
            title += f", {ended}"
            notes[f"{name} {ended}: {metrics.failure}."] = None
        if metrics.provenance.leak is True:
            title += ", LEAK"
            notes[_LEAK] = None
        rows += [[title, each, *_numbers(found)] for each, found in errors.items()]
        if errors:
            notes |= {f"{name}: {note}": None for note in missing_notes(metrics.all_errors())}
        else:
            rows.append([title, "", *[DASH] * len(COLUMNS)])
        notes |= {f"{name}: {note}": None for note in metrics.unit_notes()}
    head = ["run", "trajectory", *(column.name for column in COLUMNS)]
    return Table(head, rows, "Errors against the reference", list(notes), names=2)


def runs_json(runs: Sequence[tuple[Path, Metrics]]) -> list[dict[str, Any]]:
    """The same numbers for a program: a list with one object a run, T of ``metrics.json`` by trajectory."""
    objects = []
    for path, metrics in runs:
        tree = metrics.tree()
        entry: dict[str, Any] = {"run": str(path), "status": metrics.status}
        if metrics.failure:
            entry["reason"] = metrics.failure
        entry["leak"] = metrics.provenance.leak
        objects.append(
            entry | {key: tree.get(key) for key in ("sequence", "scale", "trajectories")}
        )
    return objects


def missing_notes(trajectories: Mapping[str, TrajectoryMetrics]) -> list[str]:
    """A line for each reason why numbers are missing, with the trajectories that lack them."""
    names: dict[str, dict[str, None]] = {}
    for name, errors in trajectories.items():
        for value, reason in (errors.at(column.path) for column in COLUMNS):
            if value is None:
                names.setdefault(reason, {})[name] = None
    return [f"{DASH} {', '.join(without)}: {reason}." for reason, without in names.items()]


def missing_errors(trajectories: Mapping[str, TrajectoryMetrics]) -> str:
    """Why no trajectory has an error; empty where one has, or where there is none."""
    values = [errors.at(column.path) for column in COLUMNS for errors in trajectories.values()]
    missing = [reason for value, reason in values if value is None]
    return missing[0] if values and len(missing) == len(values) else ""


def _numbers(errors: TrajectoryMetrics) -> list[str]:
    return [written(errors.at(column.path)[0], column.decimals) for column in COLUMNS]


def number(value: Any, decimals: int = 0) -> str:
    """A value of the metrics, a dash where it is missing."""
    return f"{value:,}" if isinstance(value, int) else written(value, decimals)


def key_numbers(metrics: Metrics, has_map: bool) -> list[tuple[str, str, str]]:
    """The key numbers that there are: name, value and unit of each; of the map where it is more than scraps."""
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
    return [
        (name, number(value, decimals), unit)
        for name, value, decimals, unit in wanted
        if value is not None
    ]


def what_ran(metrics: Metrics) -> Table:
    """Sequence, weights, scale and command, as far as they are known."""
    sequence, ran = metrics.sequence, metrics.provenance
    frames = sequence.frames and f"{sequence.frames} frames"
    rate = sequence.fps and f"{sequence.fps:.1f} a second"
    shas = [sha and f"sha256 {sha[:16]}" for sha in (ran.weights_sha256, ran.depth_sha256)]
    rows = [
        ("Sequence", _joined(sequence.name, frames, rate)),
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
    rows |= {
        f"{ring.from_m:.0f} to {ring.to_m:.0f} m from the camera": ring for ring in rings or ()
    }
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
    shares = {
        name: seconds / total
        for name, seconds in (stages | {"between stages": total - timed}).items()
    }
    ordered = sorted(shares.items(), key=lambda item: -item[1])
    rows = [
        [name, f"{share * total:.1f}", f"{share:.0%}"]
        for name, share in ordered
        if share >= _LEAST_SHARE
    ]
    memory, processor = (
        number(each) for each in (metrics.timing.peak_rss_mb, metrics.timing.cpu_seconds)
    )
    note = f"{total:.1f} s in all, {processor} s of processor time, at most {memory} MiB of memory."
    return Table(("stage", "seconds", "share"), rows, notes=[note])


def files(folder: Path) -> Table | None:
    """Every other file of the run with its meaning and size."""
    rows = [
        [
            Markup('<a href="{}"><code>{}</code></a>').format(quote(path.name), path.name),
            MEANINGS.get(path.name, ""),
            f"{max(path.stat().st_size / 1000, 1):,.0f} kB",
        ]
        for path in sorted(folder.iterdir())
        if path.is_file() and not path.name.startswith(".") and path.name != REPORT
    ]
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
    frames: dict[str, list[str]] = {}
    for each in found:
        ends = str(each.first) if each.first == each.last else f"{each.first} to {each.last}"
        frames.setdefault(each.reason, []).append(ends)
    return [f"frames {_shortened(ends)}: {reason}" for reason, ends in frames.items()]


def _shortened(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST} more" if len(names) > _MOST else ""
    return ", ".join(names[:_MOST]) + more


@dataclass(frozen=True)
class Verdict:
    """A sentence, signs that speak for the run, doubts, and why its map is no more than ``scraps``."""

    sentence: str
    signs: Sequence[str]
    doubts: Sequence[str]
    scraps: str = ""


def verdict(metrics: Metrics) -> Verdict | None:
    """What the numbers say; None of a run that did not end well."""
    if metrics.failure:
        return None
    scraps = _scraps(metrics)
    said = [
        *_confidence(metrics),
        *_loops(metrics),
        *_agreement(metrics),
        *_unit(metrics),
        *_noise(metrics),
    ]
    said += [*_rest(metrics), *([(False, scraps)] if scraps else [])]
    signs, doubts = (
        [words for is_sign, words in said if is_sign == wanted] for wanted in (True, False)
    )
    return Verdict(_sentence(metrics), signs, doubts, scraps)


def percent(share: float) -> str:
    """A share as words, with two digits where it is small."""
    return f"{100 * share:.2g} %" if abs(share) < 0.1 else f"{100 * share:.0f} %"


def _sentence(metrics: Metrics) -> str:
    align, length = metrics.trajectories.optimised.align, metrics.sequence.length_m
    error = (align.dof6 if metrics.is_metric else align.dof7).ate_rmse_m
    unit = "are in camera heights over the learned road, not in metres"
    unit = f"its lengths {unit if metrics.unit == CAMERA_HEIGHTS else 'have no metric unit'}"
    if error is None:
        sure = metrics.confidence.run
        likely = (
            f": {percent(sure)} of drives like it err by at most 1 % of their path"
            if sure is not None
            else ""
        )
        closed = next((f", and {words}" for is_sign, words in _loops(metrics) if is_sign), "")
        unit = "its lengths are in metres" if metrics.is_metric else unit
        return f"Without a truth its error is unknown{likely}{closed}; {unit}."
    part = f", {percent(error / length)} of its {length:.3g} m" if length else ""
    after = f"after one fitted scale; {unit}"
    if metrics.is_metric:
        after = (
            "with its scale from the truth"
            if metrics.scale.mode == "reference"
            else "with its own metric scale"
        )
    return f"The trajectory is {error:.2g} m off the truth (RMSE{part}), {after}."


def _unit(metrics: Metrics) -> Iterator[tuple[bool, str]]:
    scale, spread = metrics.scale, metrics.scale.spread
    if metrics.unit == METRES and (source := _FROM.get(scale.mode or "")):
        certain = f" (spread {percent(spread)})" if spread is not None else ""
        yield (
            scale.mode != "reference" and (spread or 0.0) < _WIDE_SPREAD,
            f"metres come from {source}{certain}",
        )
    fitted = metrics.trajectories.optimised.align.dof7.scale
    if metrics.is_metric and fitted and abs(fitted - 1.0) > _LARGEST_SCALE_ERROR:
        yield (
            False,
            f"lengths are {percent(abs(1.0 / fitted - 1.0))} too {'short' if fitted > 1.0 else 'long'}",
        )


def _loops(metrics: Metrics) -> Iterator[tuple[bool, str]]:
    accepted = metrics.loops.accepted
    if accepted:
        yield (
            True,
            f"{accepted} of {_count(metrics.loops.verified or accepted, 'measured loop')} agree and close it",
        )
    elif accepted == 0:
        yield False, f"no loop closes it ({metrics.loops.candidates} candidates), so drift adds up"
    else:
        yield False, f"drift adds up: {metrics.loops.why('accepted')}"


def _confidence(metrics: Metrics) -> Iterator[tuple[bool, str]]:
    sure = metrics.confidence.run
    if sure is not None:
        yield (
            sure > _SURE,
            f"{percent(sure)} of drives with images like its own err by at most 1 % of their path",
        )
    elif not metrics.confidence.absent:
        yield False, f"its confidence is not known: {metrics.confidence.why('run')}"


def _agreement(metrics: Metrics) -> Iterator[tuple[bool, str]]:
    for each in metrics.agreement or ():
        agrees = (each.sigmas or 0.0) <= DOUBTFUL
        if each.beside == "the images":
            yield (
                agrees,
                f"{each.source} {'agrees with' if agrees else 'contradicts'} the images: {each.figure}",
            )
        elif not agrees:  # `_confidence` says of all whether the run is like good ones
            yield False, f"{each.source}: {each.figure}"
    off = metrics.gps.optimised.horizontal_rmse_m
    if off is not None:
        within = "" if metrics.gps.in_graph is True else ", which it did not use"
        yield True, f"it stays within {off:.2g} m (RMSE) of the GPS track{within}"


def _noise(metrics: Metrics) -> Iterator[tuple[bool, str]]:
    coverage = metrics.graph.coverage
    shares = [
        each
        for each in (coverage.inside_50, coverage.inside_90, coverage.inside_95)
        if each is not None
    ]
    if len(shares) == 3:
        worst = max(
            (share - promised for share, promised in zip(shares, (0.5, 0.9, 0.95))), key=abs
        )
        how = (
            "holds"
            if abs(worst) < _NOISE_POINTS
            else "is too small"
            if worst < 0
            else "is too large"
        )
        told = ", ".join(f"{100 * share:.0f}" for share in shares)
        numbers = f"{told} % of its measurements lie inside their 50, 90, 95 % bounds"
        yield how == "holds", f"its stated noise {how}: {numbers}"


def _rest(metrics: Metrics) -> Iterator[tuple[bool, str]]:
    if doubled := sum(each.last - each.first + 1 for each in metrics.sequence.doubled or ()):
        yield False, f"{_count(doubled, 'frame')} repeat the one before while the camera moves"
    if (maps := metrics.tracking.maps or 1) > 1:
        events = [
            event
            for event in metrics.tracking.events or ()
            if event.frame and "begun" in event.event
        ]
        lost = ", ".join(str(event.frame) for event in events)
        yield (
            False,
            f"tracking was lost{f' at frames {lost}' if lost else ''}: {maps} maps are not joined",
        )
    if metrics.provenance.leak is True:
        yield False, "LEAK: its weights saw this sequence, or a part of it, in training"
    if (off := metrics.map.accuracy_median_m) is not None:
        yield True, f"its map lies {off:.2g} m (median) from the true surface"


def _scraps(metrics: Metrics) -> str:
    """What is wrong with a map of which too little was fused; empty of a whole one, or without a map."""
    frames, filters = metrics.map.frames_fused, metrics.map.filters
    if not frames or not filters:
        return ""
    fused = (1.0 - sum(filters.values())) * frames / (frames + (metrics.map.frames_left_out or 0))
    if fused >= _LEAST_FUSED:
        return ""
    most = max(filters, key=filters.__getitem__)
    return (
        f"its map is scraps: {percent(fused)} of the depth of its keyframes was good enough to fuse, 35 to 60 % is "
        f"usual; most was left out by the filter {most} ({percent(filters[most])})"
    )


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
