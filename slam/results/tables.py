"""Tables of the errors of trajectories: of one run, of two files under every alignment, of runs side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from erfsfm.common.table import DASH, Table
from slam.evaluation.trajectory import ALIGNMENTS, AlignedMetrics, TrajectoryMetrics
from slam.results.metrics import Metrics

UNITS = "ATE: RMSE, m; of snippets of five frames, each with its own scale, norm / 5. RE: rad. t_rel, r_rel: 7 dof."
_KMH = 3.6  # of a metre a second
_LEAK = "LEAK: the weights were trained on the sequence; the numbers are no test."


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


def headers() -> list[str]:
    """Of the columns, in their order."""
    return [column.name for column in COLUMNS]


def written(value: Any, decimals: int) -> str:
    """A number with its decimals, tiny ones in powers of ten; a dash for a missing one."""
    if value is None:
        return DASH
    if not isinstance(value, float):
        return str(value)
    tiny = value != 0 and abs(value) < 0.5 * 10.0**-decimals
    return f"{value:.1e}" if tiny else f"{value:.{decimals}f}"


def motion_line(metrics: Metrics) -> str:
    """How far and how fast a run says that the camera moved; empty where it does not say."""
    motion, unit = metrics.motion, metrics.unit
    if motion.path is None:
        return ""
    factor, speed_unit = (_KMH, "km/h") if metrics.is_metric else (1.0, f"{unit} a second")
    mean, top = (factor * (each or 0.0) for each in (motion.mean_speed, motion.top_speed))
    length = f"{written(motion.path, 1)} {'m' if metrics.is_metric else unit}"
    line = f"{length}, {written(mean, 1)} {speed_unit} on average, {written(top, 1)} at most"
    share = motion.standing_share
    return line if share is None else f"{line}, standing in {100 * share:.0f} % of the steps"


def errors_table(trajectories: Mapping[str, TrajectoryMetrics], title: str = "") -> Table:
    """The main errors, a row for each trajectory; below, the reasons of missing numbers, and whether evo agrees."""
    rows = [[name, *_numbers(errors)] for name, errors in trajectories.items()]
    notes = [UNITS]
    differences = [errors.evo.difference for errors in trajectories.values()]
    found = [difference for difference in differences if difference is not None]
    if found:
        notes.append(f"evo gives the same numbers, to {max(found):.0e}.")
    return Table(["trajectory", *headers()], rows, title, [*notes, *missing_notes(trajectories)])


def alignments_table(errors: TrajectoryMetrics, title: str = "") -> Table:
    """Every statistic of one trajectory under every alignment, and its snippets below."""
    statistics = AlignedMetrics.statistics()
    rows: list[list[str]] = []
    missing: dict[str, None] = {}
    for how in ALIGNMENTS:
        row: list[str] = [how]
        for key, statistic in statistics.items():
            value, reason = errors.at(f"align.{how}.{key}")
            row.append(written(value, statistic.decimals))
            if value is None:
                missing[reason] = None
        rows.append(row)
    snippets, evo = errors.snippet5, errors.evo
    notes = [
        f"Snippets of five frames: ATE {written(snippets.ate_mean, 4)} ± {written(snippets.ate_std, 4)} m, RE "
        f"{written(snippets.re_mean, 4)} ± {written(snippets.re_std, 4)} rad, {written(snippets.count, 0)} of them.",
        f"evo: APE {written(evo.ape_rmse_m_7dof, 3)} m at 7 dof, RPE {written(evo.rpe_trans_m, 4)} m and "
        f"{written(evo.rpe_rot_deg, 4)} deg; largest difference to ours {written(evo.difference, 1)}.",
        *(f"{DASH} {reason}." for reason in missing),
    ]
    return Table(["align", *(each.header for each in statistics.values())], rows, title, notes)


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
        if not errors:
            rows.append([title, "", *[DASH] * len(COLUMNS)])
        missing = missing_notes(metrics.all_errors()) if errors else []
        for note in (*missing, *metrics.unit_notes()):
            notes[f"{name}: {note}"] = None
    head = ["run", "trajectory", *headers()]
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
        for key in ("sequence", "scale", "trajectories"):
            entry[key] = tree.get(key)
        objects.append(entry)
    return objects


def missing_notes(trajectories: Mapping[str, TrajectoryMetrics]) -> list[str]:
    """A line for each reason why numbers are missing, with the trajectories that lack them."""
    names: dict[str, dict[str, None]] = {}
    for name, errors in trajectories.items():
        for column in COLUMNS:
            value, reason = errors.at(column.path)
            if value is None:
                names.setdefault(reason, {})[name] = None
    return [f"{DASH} {', '.join(without)}: {reason}." for reason, without in names.items()]


def missing_errors(trajectories: Mapping[str, TrajectoryMetrics]) -> str:
    """Why no trajectory has an error; empty where one has, or where there is none."""
    reason = ""
    for errors in trajectories.values():
        for value, why in (errors.at(column.path) for column in COLUMNS):
            if value is not None:
                return ""
            reason = reason or why
    return reason


def _numbers(errors: TrajectoryMetrics) -> list[str]:
    return [written(errors.at(column.path)[0], column.decimals) for column in COLUMNS]
