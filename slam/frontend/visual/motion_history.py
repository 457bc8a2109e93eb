"""History of the accepted motions of a drive, and the motion prior of two-view estimation from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from slam.frontend.visual.epipolar import UnitRelativePose
from slam.robust import mad_sigma
from slam.se3 import FloatArray

_STEPS_KEPT = 100
_LEAST_STEPS = 10


@dataclass(frozen=True)
class MotionPrior:
    """Relative error of learned depth, and the usual direction of motion ``axis`` ``(3,)`` with its sigma, radians."""

    depth_relative_error: float
    axis: FloatArray
    axis_sigma: float


def usual_error(depth_relative_errors: Sequence[float], floor: float) -> float:
    """Median relative error of learned depth over some steps, at least ``floor``."""
    return max(floor, float(np.nanmedian([*depth_relative_errors, floor])))


@dataclass(frozen=True)
class MotionHistory:
    """Directions of the last steps, relative errors of learned depth on them, and the last motion."""

    directions: tuple[FloatArray, ...] = ()
    depth_relative_errors: tuple[float, ...] = ()
    last: UnitRelativePose | None = None

    def with_step(self, measured: UnitRelativePose, depth_relative_error: float) -> Self:
        """The history after one more step, and the relative error of learned depth on it, NaN where unknown."""
        return replace(
            self,
            directions=(*self.directions, measured.direction)[-_STEPS_KEPT:],
            depth_relative_errors=(*self.depth_relative_errors, depth_relative_error)[-_STEPS_KEPT:],
            last=measured,
        )

    def prior(self, depth_relative_error: float, least_axis_sigma: float) -> MotionPrior:
        """The prior of the next motion; without a direction after too few steps."""
        if len(self.directions) < _LEAST_STEPS:
            return MotionPrior(depth_relative_error, np.zeros(3), np.inf)
        directions = np.array(self.directions)
        axis = np.median(directions, axis=0)
        axis = axis / max(float(np.linalg.norm(axis)), 1e-9)
        spread = mad_sigma(np.arccos(np.clip(directions @ axis, -1.0, 1.0)))
        return MotionPrior(depth_relative_error, axis, float(np.hypot(least_axis_sigma, spread)))
