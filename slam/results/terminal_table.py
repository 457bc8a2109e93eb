"""The errors of the trajectories of one run, or of two files, as a table for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from slam.results.comparison import (
    ALIGNED_ATE,
    EVO_DIFFERENCE,
    MISSING,
    R_REL,
    SNIPPET_ATE,
    SNIPPET_RE,
    T_REL,
    ErrorColumn,
    lookup,
    written,
)

if TYPE_CHECKING:
    from rich.table import Table

EVO_APE = ErrorColumn(("evo", "ape_rmse_m_7dof"), "APE RMSE by evo, 7 dof", "evo\nAPE", 3)
_COLUMNS = (SNIPPET_ATE, SNIPPET_RE, *ALIGNED_ATE, T_REL, R_REL, EVO_APE, EVO_DIFFERENCE)


def metrics_table(trajectories: Mapping[str, Mapping[str, Any] | None], title: str) -> Table:
    """One row a trajectory, in the order given; below, the reasons of missing numbers.

    Args:
        trajectories: the object T of ``metrics.json`` (or None) by the name of the trajectory.
        title: what was compared, with the scale mode, which decides the unit of lengths.
    """
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title), title_justify="left", caption_justify="left", pad_edge=False, box=SIMPLE_HEAD)
    table.add_column("trajectory", overflow="fold", min_width=10)
    for statistic in _COLUMNS:
        table.add_column(statistic.short, justify="right", no_wrap=True, min_width=statistic.decimals + 2)
    reasons: dict[str, dict[str, None]] = {}
    for name, metrics in trajectories.items():
        table.add_row(Text(name), *(_cell(metrics, statistic) for statistic in _COLUMNS))
        for statistic in _COLUMNS:
            reason = lookup(metrics, *statistic.path)[1]
            if reason:
                reasons.setdefault(reason, {})[name] = None
    notes = [f"{MISSING} {', '.join(names)}: {reason}." for reason, names in reasons.items()]
    units = "Snippet ATE (mean ± deviation of norm / 5) and ATE RMSE in metres, snippet RE in radians."
    table.caption = Text("\n".join([units, *notes]))
    return table


def _cell(metrics: Mapping[str, Any] | None, statistic: ErrorColumn) -> str:
    value = written(lookup(metrics, *statistic.path)[0], statistic.decimals)
    if statistic is not SNIPPET_ATE or value == MISSING:
        return value
    return f"{value} ± {written(lookup(metrics, 'snippet5', 'ate_std')[0], statistic.decimals)}"
