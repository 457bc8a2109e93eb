"""Errors of trajectories as tables for the terminal: of one run or two files, and of several runs side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from slam.results.error_columns import (
    COLUMNS,
    DASH,
    EVO_DIFFERENCE,
    SNIPPET_ATE,
    ErrorColumn,
    Errors,
    missing_by_reason,
    written,
)
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics
from slam.runtime.errors import RunError
from slam.runtime.run_files import TRAJECTORIES
from slam.runtime.storage.record import Missing, known

if TYPE_CHECKING:
    from rich.table import Table

_EVO_APE = ErrorColumn(lambda e: e.evo.ape_rmse_m_7dof, "APE RMSE by evo, 7 dof", "evo\nAPE", 3)
_ONE_RUN = (*COLUMNS[:-1], _EVO_APE, EVO_DIFFERENCE)


def metrics_table(trajectories: Mapping[str, Errors], title: str) -> Table:
    """One row a trajectory, in the order given; below, the reasons of missing numbers.

    Args:
        trajectories: errors by the name of the trajectory.
        title: what was compared, with the scale mode, which decides the unit of lengths.
    """
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title), title_justify="left", caption_justify="left", pad_edge=False, box=SIMPLE_HEAD)
    table.add_column("trajectory", overflow="fold", min_width=10)
    _add_columns(table, _ONE_RUN)
    for name, errors in trajectories.items():
        cells = (c.text(errors) if c is SNIPPET_ATE else written(c.value(errors), c.decimals) for c in _ONE_RUN)
        table.add_row(Text(name), *cells)
    reasons = missing_by_reason(trajectories, _ONE_RUN)
    notes = [f"{DASH} {', '.join(names)}: {reason}." for reason, names in reasons.items()]
    units = "Snippet ATE (mean ± deviation of norm / 5) and ATE RMSE in metres, snippet RE in radians."
    table.caption = Text("\n".join([units, *notes]))
    return table


def comparison_table(runs: Sequence[RunFolder]) -> Table:
    """One row for each run and trajectory; runs that failed or were killed with the reason.

    Raises:
        RunError: no run was given, or its ``metrics.json`` is damaged.
    """
    from rich.table import Table
    from rich.text import Text

    contents = _contents(runs)
    table = Table(title="Errors against the reference", title_justify="left", caption_justify="left")
    table.add_column("run", overflow="fold", min_width=10)
    table.add_column("trajectory", no_wrap=True)
    _add_columns(table, COLUMNS)
    notes: dict[str, None] = {}
    for name, metrics in zip(_names(runs), contents):
        leak = metrics.provenance.leak is True
        title = Text.assemble(name, ("\nLEAK", "bold red") if leak else "")
        if metrics.failure:
            ended = "failed" if metrics.status == "failed" else "did not end"
            notes[f"{name} {ended}: {metrics.failure}."] = None
            title.append(f"\n{ended}", "bold red")
        all_errors: dict[str, Errors] = {each: getattr(metrics.trajectories, each) for each in TRAJECTORIES}
        errors = {each: found for each, found in all_errors.items() if not isinstance(found, Missing)}
        columns = ["\n".join(written(c.value(e), c.decimals) for e in errors.values()) for c in COLUMNS]
        table.add_row(title, "\n".join(errors), *columns, end_section=True)
        if errors:
            for why, where in missing_by_reason(all_errors, COLUMNS).items():
                notes[f"{DASH} {name}, {' and '.join(where)}: {why}."] = None
        if leak:
            notes["LEAK: the weights were trained on the sequence; the numbers are no test."] = None
        notes.update({f"{name}: {note}": None for note in metrics.unit_notes()})
    table.caption = Text("\n".join(["ATE and snippet ATE in metres, snippet RE in radians.", *notes]))
    return table


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
        entry["leak"] = known(metrics.provenance.leak)
        objects.append(entry | {key: tree.get(key) for key in ("sequence", "scale", "trajectories")})
    return objects


def _add_columns(table: Table, columns: Sequence[ErrorColumn]) -> None:
    for column in columns:
        table.add_column(column.short, justify="right", min_width=column.decimals + 2, no_wrap=True)


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
    if isinstance(metrics.trajectories, Missing) and run.trajectory("optimised") is not None:
        from slam.results.estimate_metrics import metrics_of_trajectories

        return metrics.changed(trajectories=metrics_of_trajectories(run))
    return metrics
