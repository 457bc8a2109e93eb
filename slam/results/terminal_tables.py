"""Errors of trajectories as tables for the terminal: of one run or two files, and of several runs side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from slam.evaluation.trajectory import TrajectoryMetrics
from slam.results.error_columns import (
    COLUMNS,
    DASH,
    EVO_DIFFERENCE,
    SNIPPET_ATE,
    ErrorColumn,
    missing_by_reason,
    written,
)
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics
from slam.runtime.errors import RunError
from slam.runtime.terminal import TerminalTable

UNITS = "Snippet ATE (norm / 5), ATE RMSE and RPE (mean) in metres; snippet RE in radians; r_rel in degrees per 100 m."
_EVO_APE = ErrorColumn("evo.ape_rmse_m_7dof", "APE RMSE by evo, 7 dof", "evo APE\n7dof", 3)
_ONE_RUN = (*COLUMNS[:-1], _EVO_APE, EVO_DIFFERENCE)


def metrics_table(trajectories: Mapping[str, TrajectoryMetrics], title: str) -> TerminalTable:
    """One row a trajectory, in the order given; below, the reasons of missing numbers.

    Args:
        trajectories: errors by the name of the trajectory.
        title: what was compared, with the scale mode, which decides the unit of lengths.
    """
    rows = [
        [name, *(c.text(errors) if c is SNIPPET_ATE else written(errors.at(c.path)[0], c.decimals) for c in _ONE_RUN)]
        for name, errors in trajectories.items()
    ]
    reasons = missing_by_reason(trajectories, _ONE_RUN)
    notes = [f"{DASH} {', '.join(names)}: {reason}." for reason, names in reasons.items()]
    return TerminalTable(["trajectory", *(c.short for c in _ONE_RUN)], rows, title, [UNITS, *notes])


def comparison_table(runs: Sequence[RunFolder]) -> TerminalTable:
    """One row for each run and trajectory; runs that failed or were killed with the reason.

    Raises:
        RunError: no run was given, or its ``metrics.json`` is damaged.
    """
    rows: list[list[str]] = []
    notes: dict[str, None] = {UNITS: None}
    for name, metrics in zip(_names(runs), _contents(runs)):
        errors = metrics.evaluated_errors()
        title = name
        if metrics.failure:
            ended = "failed" if metrics.status == "failed" else "did not end"
            title += f", {ended}"
            notes[f"{name} {ended}: {metrics.failure}."] = None
        if metrics.provenance.leak is True:
            title += ", LEAK"
            notes["LEAK: the weights were trained on the sequence; the numbers are no test."] = None
        for each, found in errors.items():
            rows.append([title, each, *(written(found.at(c.path)[0], c.decimals) for c in COLUMNS)])
        if errors:
            for why, where in missing_by_reason(metrics.all_errors(), COLUMNS).items():
                notes[f"{DASH} {name}, {' and '.join(where)}: {why}."] = None
        else:
            rows.append([title, "", *[DASH] * len(COLUMNS)])
        notes.update({f"{name}: {note}": None for note in metrics.unit_notes()})
    head = ["run", "trajectory", *(c.short for c in COLUMNS)]
    return TerminalTable(head, rows, "Errors against the reference", list(notes), names=2)


def comparison_json(runs: Sequence[RunFolder]) -> list[dict[str, Any]]:
    """The same numbers for a program: a list with one object a run, T of ``metrics.json`` by trajectory.

    Raises:
        RunError: no run was given, or its ``metrics.json`` is damaged.
    """
    objects = []
    for run, metrics in zip(runs, _contents(runs)):
        tree = metrics.tree()
        entry: dict[str, Any] = {"run": str(run.path), "status": metrics.status}
        if metrics.failure:
            entry["reason"] = metrics.failure
        entry["leak"] = metrics.provenance.leak
        objects.append(entry | {key: tree.get(key) for key in ("sequence", "scale", "trajectories")})
    return objects


def _names(runs: Sequence[RunFolder]) -> list[str]:
    """Short names of runs: the folder's own, or the whole path where it is not unique."""
    names = [run.path.resolve().name for run in runs]
    return [str(run.path) if names.count(name) > 1 else name for run, name in zip(runs, names)]


def _contents(runs: Sequence[RunFolder]) -> list[Metrics]:
    if not runs:
        raise RunError("no run was given: name one or more run folders")
    return [_metrics(run) for run in runs]


def _metrics(run: RunFolder) -> Metrics:
    """The metrics of a run; where it was killed before it wrote them, those of its trajectories."""
    metrics = run.metrics()
    if metrics.trajectories.absent and run.trajectory("optimised") is not None:
        from slam.results.estimate_metrics import metrics_of_trajectories

        return metrics.changed(trajectories=metrics_of_trajectories(run))
    return metrics
