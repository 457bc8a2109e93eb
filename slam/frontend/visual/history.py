"""The last steps of a drive: the usual direction of motion, inliers and speeds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from slam.geometry.multiview import UnitRelativePose
from slam.geometry.robust import mad_sigma, median
from slam.geometry.se3 import FloatArray, length_of

AXIS_SIGMA = float(np.deg2rad(8.0))  # least sigma of the direction of motion, radians
_STEPS_KEPT = 100
_LEAST_STEPS = 10
_SUDDEN_SHARE = 2.0 / 3.0
_SHARES = 10
_SPEEDS = 3
# of a car, in camera heights: 10 m/s2 at 1.65 m
_MOST_ACCELERATION = 6.0
_LENGTH_RELATIVE_SIGMA = 0.1


@dataclass(frozen=True)
class MotionPrior:
    """The usual direction of motion ``axis`` ``(3,)`` and its sigma, radians."""

    axis: FloatArray
    axis_sigma: float

    def deviation(self, direction: FloatArray) -> float:
        """Angle of a ``direction`` ``(3,)`` from the axis, sigmas; forwards and backwards are equal."""
        return float(np.arccos(min(abs(float(self.axis @ direction)), 1.0))) / self.axis_sigma


@dataclass(frozen=True)
class MotionHistory:
    """Directions, inlier ratios and speeds (camera heights a second, NaN where unknown) of the last steps.

    ``last`` is the last motion.
    """

    directions: tuple[FloatArray, ...] = ()
    inlier_ratios: tuple[float, ...] = ()
    speeds: tuple[float, ...] = ()
    last: UnitRelativePose | None = None

    def with_step(self, measured: UnitRelativePose, inlier_ratio: float, speed: float) -> Self:
        """The history after one more step."""
        return replace(
            self,
            directions=(*self.directions, measured.direction)[-_STEPS_KEPT:],
            inlier_ratios=(*self.inlier_ratios, inlier_ratio)[-_SHARES:],
            speeds=(*self.speeds, speed)[-_SPEEDS:],
            last=measured,
        )

    def is_sudden_loss(self, inlier_ratio: float) -> bool:
        """Whether a third of the usual inliers are outliers now."""
        known = len(self.inlier_ratios) >= _LEAST_STEPS
        return known and inlier_ratio < _SUDDEN_SHARE * median(self.inlier_ratios)

    def is_possible_speed(self, speed: float, seconds: float) -> bool | None:
        """Whether a car can have this speed after a step of so many seconds; None where speeds are unknown.

        Lengths by learned depth have a relative error of their own, three sigmas of which are
        granted.
        """
        if len(self.speeds) < _SPEEDS or not np.isfinite([*self.speeds, speed]).all():
            return None
        usual = median(self.speeds)
        passed = seconds * (_SPEEDS + 1) / 2
        return abs(
            speed - usual
        ) < _MOST_ACCELERATION * passed + 3.0 * _LENGTH_RELATIVE_SIGMA * max(speed, usual)

    def prior(self) -> MotionPrior:
        """The prior of the next motion; without a direction after too few steps."""
        if len(self.directions) < _LEAST_STEPS:
            return MotionPrior(np.zeros(3), np.inf)
        directions = np.array(self.directions)
        axis = np.median(directions, axis=0)
        axis = axis / max(length_of(axis), 1e-9)
        spread = mad_sigma(np.arccos(np.clip(directions @ axis, -1.0, 1.0)))
        return MotionPrior(axis, float(np.hypot(AXIS_SIGMA, spread)))
