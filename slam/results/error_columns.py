"""The errors of a trajectory that tables show, how numbers are written there, and reasons of missing ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from slam.evaluation.trajectory import TrajectoryMetrics
from slam.runtime.storage.record import Missing

DASH = "–"
Errors = TrajectoryMetrics | Missing


@dataclass(frozen=True)
class ErrorColumn:
    """One number of a trajectory, with its deviation where it has one; names and number of decimals."""

    value: Callable[[Errors], float | Missing]
    name: str
    short: str
    decimals: int
    deviation: Callable[[Errors], float | Missing] | None = None

    def text(self, errors: Errors) -> str:
        """The number as tables show it."""
        value = written(self.value(errors), self.decimals)
        deviation = Missing() if self.deviation is None else self.deviation(errors)
        return value if isinstance(deviation, Missing) else f"{value} ± {written(deviation, self.decimals)}"


SNIPPET_ATE = ErrorColumn(
    lambda e: e.snippet5.ate_mean, "snippet ATE, m", "snippet\nATE", 4, lambda e: e.snippet5.ate_std
)
SNIPPET_RE = ErrorColumn(lambda e: e.snippet5.re_mean, "snippet RE, rad", "snippet\nRE", 4, lambda e: e.snippet5.re_std)
ALIGNED_ATE = (
    ErrorColumn(lambda e: e.align.none.ate_rmse_m, "ATE RMSE, as written", "ATE\nnone", 3),
    ErrorColumn(lambda e: e.align.first.ate_rmse_m, "ATE RMSE, first pose", "ATE\nfirst", 3),
    ErrorColumn(lambda e: e.align.scale.ate_rmse_m, "ATE RMSE, first pose and scale", "ATE\nscale", 3),
    ErrorColumn(lambda e: e.align.dof6.ate_rmse_m, "ATE RMSE, 6 dof", "ATE\n6dof", 3),
    ErrorColumn(lambda e: e.align.dof7.ate_rmse_m, "ATE RMSE, 7 dof", "ATE\n7dof", 3),
)
T_REL = ErrorColumn(lambda e: e.align.dof7.t_rel_percent, "t_rel, %, 7 dof", "t_rel %\n7dof", 2)
R_REL = ErrorColumn(lambda e: e.align.dof7.r_rel_deg_per_100m, "r_rel, deg / 100 m, 7 dof", "r_rel\n7dof", 3)
RPE_M = ErrorColumn(lambda e: e.align.dof7.rpe_trans_m, "RPE, m, 7 dof", "RPE m\n7dof", 4)
RPE_DEG = ErrorColumn(lambda e: e.align.dof7.rpe_rot_deg, "RPE, deg, 7 dof", "RPE deg\n7dof", 3)
EVO_DIFFERENCE = ErrorColumn(lambda e: e.evo.difference, "largest difference to evo", "to\nevo", 1)
COLUMNS = (SNIPPET_ATE, SNIPPET_RE, *ALIGNED_ATE, T_REL, R_REL, RPE_M, RPE_DEG, EVO_DIFFERENCE)


def written(value: Any, decimals: int) -> str:
    """A number with its decimals, tiny ones in powers of ten; a dash for a missing one."""
    if value is None or isinstance(value, Missing):
        return DASH
    if not isinstance(value, float):
        return str(value)
    tiny = value != 0 and abs(value) < 0.5 * 10.0**-decimals
    return f"{value:.1e}" if tiny else f"{value:.{decimals}f}"


def missing_by_reason(trajectories: Mapping[str, Errors], columns: Sequence[ErrorColumn]) -> dict[str, list[str]]:
    """Names of the trajectories that lack a number, by the reason."""
    names: dict[str, dict[str, None]] = {}
    for name, errors in trajectories.items():
        for value in (column.value(errors) for column in columns):
            if isinstance(value, Missing):
                names.setdefault(value.reason, {})[name] = None
    return {reason: list(found) for reason, found in names.items()}
