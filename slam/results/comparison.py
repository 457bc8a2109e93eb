"""The numbers of several runs side by side, read from their ``metrics.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from slam.results.folder import TRAJECTORIES, RunFolder
from slam.runtime.errors import RunError

if TYPE_CHECKING:
    from rich.table import Table

MISSING = "–"
NOT_RECORDED = "not recorded"
METRES = "metres"
CAMERA_HEIGHTS = "camera heights"


@dataclass(frozen=True)
class ErrorColumn:
    """One number of a trajectory: its path inside T, name and number of decimals."""

    path: tuple[str, ...]
    name: str
    short: str
    decimals: int


SNIPPET_ATE = ErrorColumn(("snippet5", "ate_mean"), "snippet ATE, m", "snip.\nATE", 4)
SNIPPET_RE = ErrorColumn(("snippet5", "re_mean"), "snippet RE, rad", "snip.\nRE", 4)
ALIGNED_ATE = tuple(
    ErrorColumn(("align", how, "ate_rmse_m"), f"ATE RMSE, {label}", f"ATE\n{short}", 3)
    for how, label, short in (
        ("none", "as written", "none"),
        ("first", "first pose", "first"),
        ("scale", "first pose and scale", "scale"),
        ("6dof", "6 dof", "6dof"),
        ("7dof", "7 dof", "7dof"),
    )
)
T_REL = ErrorColumn(("align", "7dof", "t_rel_percent"), "t_rel, % (7 dof)", "t_rel\n%", 2)
R_REL = ErrorColumn(("align", "7dof", "r_rel_deg_per_100m"), "r_rel, deg / 100 m", "r_rel\n°/100m", 3)
EVO_DIFFERENCE = ErrorColumn(("evo", "difference"), "largest difference to evo", "to\nevo", 1)
STATISTICS = (SNIPPET_ATE, SNIPPET_RE, *ALIGNED_ATE, T_REL, R_REL, EVO_DIFFERENCE)


def lookup(tree: Mapping[str, Any] | None, *path: str) -> tuple[Any, str]:
    """A value inside nested metrics and an empty reason, or None and why it is missing.

    The reason is the sibling ``<name>_reason`` of the first key on the path that is null or absent.
    """
    node: Any = tree
    for name in path:
        if not isinstance(node, Mapping):
            return None, NOT_RECORDED
        value = node.get(name)
        if value is None:
            return None, str(node.get(f"{name}_reason") or NOT_RECORDED)
        node = value
    return (None, NOT_RECORDED) if node is None else (node, "")


def written(value: Any, decimals: int) -> str:
    """A number with its decimals, tiny ones in powers of ten; a dash for None."""
    if value is None:
        return MISSING
    if isinstance(value, int) or not isinstance(value, float):
        return str(value)
    tiny = value != 0 and abs(value) < 0.5 * 10.0**-decimals
    return f"{value:.1e}" if tiny else f"{value:.{decimals}f}"


def failure(metrics: Mapping[str, Any]) -> str:
    """Why a run failed, in one line; empty if it did not."""
    if metrics.get("status") == "ok":
        return ""
    reason = metrics.get("reason") or metrics.get("status_reason") or metrics.get("error") or "no reason recorded"
    return " ".join(str(reason).split())


def unit_of_lengths(metrics: Mapping[str, Any]) -> str:
    """``metres``, ``camera heights``, or ``the networks' own unit`` where no road was found."""
    mode, value, unit = (lookup(metrics, "scale", key)[0] for key in ("mode", "value", "unit"))
    if unit is not None:
        return str(unit)
    # a run of before the unit was recorded
    if value is None and mode in ("none", "camera-height", "lidar"):
        return "the networks' own unit"
    if mode == "none" or (value is None and mode is not None):
        return CAMERA_HEIGHTS
    return METRES


def is_metric(metrics: Mapping[str, Any]) -> bool:
    """Whether lengths of a run are metres; they are if the run does not tell."""
    return unit_of_lengths(metrics) == METRES


def unit_notes(metrics: Mapping[str, Any]) -> list[str]:
    """Notes on the unit of length of a run."""
    mode, unit = lookup(metrics, "scale", "mode")[0], unit_of_lengths(metrics)
    notes = []
    if mode == "none" and unit == CAMERA_HEIGHTS:
        notes.append(
            "Scale mode none: lengths of odometry, optimised and the map are in camera heights of the learned road "
            "plane, not in metres; only the alignments with scale (scale, 7 dof) compare with metres. "
            "For metres: camera_height_m in camera.yaml, a GPS track or scale.mode=known."
        )
    elif unit != METRES:
        reason = lookup(metrics, "scale", "value")[1]
        notes.append(f"No scale was found ({reason}): lengths are in {unit}, not in metres.")
    return notes


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
    for statistic in STATISTICS:
        table.add_column(statistic.short, justify="right", min_width=statistic.decimals + 2, no_wrap=True)
    notes: dict[str, None] = {}
    for name, metrics in zip(run_names(runs), contents):
        leak, _ = lookup(metrics, "provenance", "leak")
        title = Text.assemble(name, ("\nLEAK", "bold red") if leak else "")
        if failure(metrics):
            ended = "failed" if metrics.get("status") == "failed" else "did not end"
            notes[f"{name} {ended}: {failure(metrics)}."] = None
            title.append(f"\n{ended}", "bold red")
        rows = _rows(name, metrics, notes) if metrics.get("trajectories") else []
        names, *columns = zip(*rows) if rows else [()] * (1 + len(STATISTICS))
        table.add_row(title, *("\n".join(cells) for cells in (names, *columns)), end_section=True)
        if leak:
            notes["LEAK: the weights were trained on the sequence; the numbers are no test."] = None
        notes.update({f"{name}: {note}": None for note in unit_notes(metrics)})
    table.caption = Text("\n".join(["ATE and snippet ATE in metres, snippet RE in radians.", *notes]))
    return table


def comparison_json(runs: Sequence[RunFolder]) -> list[dict[str, Any]]:
    """The same numbers for a program: a list with one object a run, T of ``metrics.json`` by trajectory.

    Raises:
        RunError: no run was given, or its ``metrics.json`` is damaged.
    """
    objects = []
    for run, metrics in zip(runs, _contents(runs)):
        entry: dict[str, Any] = {"run": str(run.path), "status": metrics.get("status")}
        if failure(metrics):
            entry["reason"] = failure(metrics)
        entry["leak"] = lookup(metrics, "provenance", "leak")[0]
        for key in ("sequence", "scale", "trajectories"):
            entry[key] = metrics.get(key)
        objects.append(entry)
    return objects


def run_names(runs: Sequence[RunFolder]) -> list[str]:
    """Short names of runs: the folder's own, or the whole path where it is not unique."""
    names = [run.path.resolve().name for run in runs]
    return [str(run.path) if names.count(name) > 1 else name for run, name in zip(runs, names)]


def _contents(runs: Sequence[RunFolder]) -> list[dict[str, Any]]:
    if not runs:
        raise RunError("no run was given: name one or more run folders")
    return [_numbers(run) for run in runs]


def _numbers(run: RunFolder) -> dict[str, Any]:
    """The metrics of a run; where it was killed before it wrote them, those of its trajectories."""
    metrics = run.metrics()
    if "trajectories" not in metrics and run.trajectory("optimised") is not None:
        from slam.results.metrics import trajectory_metrics_of

        metrics["trajectories"] = trajectory_metrics_of(run)
    return metrics


def _rows(name: str, metrics: Mapping[str, Any], notes: dict[str, None]) -> list[list[str]]:
    """Cells of each trajectory, its name first; reasons of missing numbers go to the notes."""
    rows = []
    missing: dict[str, dict[str, None]] = {}
    for trajectory in TRAJECTORIES:
        numbers, reason = lookup(metrics, "trajectories", trajectory)
        if numbers is None:
            missing.setdefault(reason, {})[trajectory] = None
            continue
        values = [lookup(numbers, *statistic.path) for statistic in STATISTICS]
        for _, why in values:
            if why:
                missing.setdefault(why, {})[trajectory] = None
        cells = [written(value, statistic.decimals) for (value, _), statistic in zip(values, STATISTICS)]
        rows.append([trajectory, *cells])
    notes.update({f"{MISSING} {name}, {' and '.join(where)}: {why}.": None for why, where in missing.items()})
    return rows
