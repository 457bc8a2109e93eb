"""The errors of a trajectory that tables show, how numbers are written there, and reasons of missing ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from slam.evaluation.trajectory import TrajectoryMetrics

DASH = "–"


@dataclass(frozen=True)
class ErrorColumn:
    """One number of a trajectory by its path, with its deviation where it has one; names and number of decimals."""

    path: str
    name: str
    short: str
    decimals: int
    deviation: str = ""

    def text(self, errors: TrajectoryMetrics) -> str:
        """The number as tables show it."""
        value = written(errors.at(self.path)[0], self.decimals)
        deviation = errors.at(self.deviation)[0] if self.deviation else None
        return value if deviation is None else f"{value} ± {written(deviation, self.decimals)}"


SNIPPET_ATE = ErrorColumn("snippet5.ate_mean", "snippet ATE, m", "snippet\nATE", 4, "snippet5.ate_std")
SNIPPET_RE = ErrorColumn("snippet5.re_mean", "snippet RE, rad", "snippet\nRE", 4, "snippet5.re_std")
ALIGNED_ATE = (
    ErrorColumn("align.none.ate_rmse_m", "ATE RMSE, as written", "ATE\nnone", 3),
    ErrorColumn("align.first.ate_rmse_m", "ATE RMSE, first pose", "ATE\nfirst", 3),
    ErrorColumn("align.scale.ate_rmse_m", "ATE RMSE, first pose and scale", "ATE\nscale", 3),
    ErrorColumn("align.6dof.ate_rmse_m", "ATE RMSE, 6 dof", "ATE\n6dof", 3),
    ErrorColumn("align.7dof.ate_rmse_m", "ATE RMSE, 7 dof", "ATE\n7dof", 3),
)
T_REL = ErrorColumn("align.7dof.t_rel_percent", "t_rel, %, 7 dof", "t_rel %\n7dof", 2)
R_REL = ErrorColumn("align.7dof.r_rel_deg_per_100m", "r_rel, deg / 100 m, 7 dof", "r_rel\n7dof", 3)
RPE_M = ErrorColumn("align.7dof.rpe_trans_m", "RPE, m, 7 dof", "RPE m\n7dof", 4)
RPE_DEG = ErrorColumn("align.7dof.rpe_rot_deg", "RPE, deg, 7 dof", "RPE deg\n7dof", 3)
EVO_DIFFERENCE = ErrorColumn("evo.difference", "largest difference to evo", "to\nevo", 1)
COLUMNS = (SNIPPET_ATE, SNIPPET_RE, *ALIGNED_ATE, T_REL, R_REL, RPE_M, RPE_DEG, EVO_DIFFERENCE)


def written(value: Any, decimals: int) -> str:
    """A number with its decimals, tiny ones in powers of ten; a dash for a missing one."""
    if value is None:
        return DASH
    if not isinstance(value, float):
        return str(value)
    tiny = value != 0 and abs(value) < 0.5 * 10.0**-decimals
    return f"{value:.1e}" if tiny else f"{value:.{decimals}f}"


def missing_by_reason(
    trajectories: Mapping[str, TrajectoryMetrics], columns: Sequence[ErrorColumn]
) -> dict[str, list[str]]:
    """Names of the trajectories that lack a number, by the reason."""
    names: dict[str, dict[str, None]] = {}
    for name, errors in trajectories.items():
        for value, reason in (errors.at(column.path) for column in columns):
            if value is None:
                names.setdefault(reason, {})[name] = None
    return {reason: list(found) for reason, found in names.items()}
