"""The focal length that corners show, beside the one that is stated.

Under a wrong focal length no motion explains the corners of a camera that turns: the essential matrix of wrong rays has
two singular values that differ (Hartley and Zisserman 2004, section 9.6). A camera that goes straight on shows nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from slam.frontend.visual.residuals import Residuals, tangent_of
from slam.geometry.epipolar import UnitRelativePose
from slam.geometry.robust import mad_sigma
from slam.geometry.se3 import FloatArray

_STEP = 0.01  # of the logarithm, for its derivative
_LEAST_SIGMA_PX = 1e-3
_CORRELATION = 4.0  # of the errors of corners, and of those that flow makes where a camera hardly turns


@dataclass(frozen=True)
class FocalLength:
    """What the steps of a drive say of the logarithm of true over stated focal length: information and gradient."""

    information: float = 0.0
    gradient: float = 0.0

    @property
    def error(self) -> tuple[float, float] | None:
        """The logarithm and its sigma, linear in a small error; None where nothing turned."""
        if self.information <= 0:
            return None
        return -self.gradient / self.information, _CORRELATION / float(np.sqrt(self.information))

    def with_step(
        self, rays_previous: FloatArray, rays_current: FloatArray, unit_pose: UnitRelativePose, focal_px: float
    ) -> Self:
        """After one more step, whose rotation and direction are eliminated.

        By the rays ``(M, 3)``, z = 1, of corners on their epipolar lines; ``focal_px`` is the stated focal length.
        """
        tangent, unknown = tangent_of(unit_pose.direction), np.full(len(rays_previous), np.nan)

        def across(ratio: float) -> tuple[FloatArray, FloatArray]:
            scale = np.array([1.0 / ratio, 1.0 / ratio, 1.0])
            residuals = Residuals(rays_previous * scale, rays_current * scale, unknown, focal_px * ratio)
            return residuals.across(unit_pose, tangent)

        residual, by_motion = across(1.0)
        by_focal = (across(1.0 + _STEP)[0] - residual) / np.log1p(_STEP)
        sigma = max(mad_sigma(residual), _LEAST_SIGMA_PX)
        weights = 1.0 / (sigma**2 * (1.0 + (residual / (2.0 * sigma)) ** 2))
        weighted = by_motion * weights
        normal = weighted @ by_motion.T + 1e-9 * np.eye(len(by_motion))
        explained = by_focal - np.linalg.solve(normal, weighted @ by_focal) @ by_motion
        information, gradient = (float(explained @ (weights * by)) for by in (by_focal, residual))
        return type(self)(self.information + information, self.gradient + gradient)
