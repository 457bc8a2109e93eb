"""Prior on the direction of motion, predicted from a vehicle's rotation within a fraction of a degree.

Corners determine the direction of translation and the rotation together: with few corners a translation to the
right is hard to distinguish from a yaw to the left, and the errors of both have a correlation of 0.8
(``docs/design/visual-front-end.md``). The direction of a steered vehicle is a function of its rotation.
It is approximated by a line fitted to the last steps of the drive; a Kalman update fuses it with each measurement. On
a freely moving camera the residuals of the line are large and the update has no effect.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from slam.frontend.visual.epipolar import UnitRelativePose
from slam.se3 import FloatArray

_STEPS_KEPT = 200
_LEAST_STEPS = 20
_REWEIGHTINGS = 4
_STUDENT_T_DOF = 4.0
_WIDEST_SIGMA = np.deg2rad(20.0)
_SIGMAS_TRIED = 24
# prior sigma of the slope of direction over rotation
_SLOPE_SIGMA = 2.0
# an innovation of so many sigmas has half its weight
_HALF_WEIGHT_SIGMAS = 2.0


@dataclass(frozen=True)
class HeadingPrior:
    """Rotations, directions and covariances of the directions of the last steps of one drive.

    ``least_sigma`` is that of a direction predicted from a rotation, radians.
    """

    least_sigma: float
    rotations: tuple[FloatArray, ...] = ()
    directions: tuple[FloatArray, ...] = ()
    covariances: tuple[FloatArray, ...] = ()

    def fuse(self, unit_pose: UnitRelativePose, covariance: FloatArray) -> tuple[UnitRelativePose, FloatArray]:
        """A measurement fused with the direction predicted from its rotation.

        One update of a Kalman filter, down-weighted where the innovation is large.

        Args:
            unit_pose: measured.
            covariance: its own ``(6, 6)``, rotation then direction, both in the current camera, radians.

        Returns:
            The motion and its covariance after the update.
        """
        if len(self.rotations) < _LEAST_STEPS:
            return unit_pose, covariance
        rotation = Rotation.from_matrix(unit_pose.R_current_previous).as_rotvec()
        axis = np.median(self.directions, axis=0)
        lateral = np.linalg.svd(axis[None])[2][1:].T  # (3, 2)
        if axis @ unit_pose.direction <= 0:  # reversing
            return unit_pose, covariance
        predicted, variance = self._predicted(lateral, rotation)
        to_direction = covariance[:, 3:] @ lateral  # (6, 2)
        innovation = predicted - lateral.T @ unit_pose.direction
        information = np.linalg.inv(lateral.T @ to_direction[3:] + np.diag(variance))
        squared = float(innovation @ information @ innovation)
        gain = to_direction @ information / (1.0 + squared / _HALF_WEIGHT_SIGMAS**2)
        correction = gain @ innovation
        R_current_previous = Rotation.from_rotvec(correction[:3]).as_matrix() @ unit_pose.R_current_previous
        direction = unit_pose.direction + correction[3:]
        left = covariance - gain @ to_direction.T
        return UnitRelativePose(R_current_previous, direction / np.linalg.norm(direction)), 0.5 * (left + left.T)

    def with_step(self, unit_pose: UnitRelativePose, covariance: FloatArray) -> Self:
        """The prior after one more measured step and its covariance ``(6, 6)``, both before `fuse`."""
        rotation = Rotation.from_matrix(unit_pose.R_current_previous).as_rotvec()
        return replace(
            self,
            rotations=(*self.rotations, rotation)[-_STEPS_KEPT:],
            directions=(*self.directions, unit_pose.direction)[-_STEPS_KEPT:],
            covariances=(*self.covariances, covariance[3:, 3:])[-_STEPS_KEPT:],
        )

    def _predicted(self, lateral: FloatArray, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Both lateral components of the direction ``(2,)`` for a rotation ``(3,)``, and their variances ``(2,)``.

        A line through the steps kept, fitted by reweighted least squares. Its residual sigma, beside the steps' own
        covariances, is the most likely one under Student's t.
        """
        sigmas = np.geomspace(self.least_sigma, max(_WIDEST_SIGMA, self.least_sigma), _SIGMAS_TRIED)
        rotations = np.concatenate([np.ones((1, len(self.rotations))), np.array(self.rotations).T])  # (4, N)
        measured_lateral = lateral.T @ np.array(self.directions).T  # (2, N)
        squares = (lateral[:, None] * lateral).reshape(9, 2)
        own = squares.T @ np.array(self.covariances).reshape(-1, 9).T
        variances = sigmas[:, None, None] ** 2 + own  # (S, 2, N)
        narrow = np.log(variances).sum(axis=2)
        lines = np.zeros((2, 4))
        lines[:, 0] = np.median(measured_lateral, axis=1)
        ridge = np.diag([0.0, *(3 * [_SLOPE_SIGMA**-2.0])])
        for _ in range(_REWEIGHTINGS):
            squared = (measured_lateral - lines @ rotations) ** 2
            misfit = np.log(1.0 + squared / (_STUDENT_T_DOF * variances)).sum(axis=2)
            sigma = sigmas[(narrow + (_STUDENT_T_DOF + 1.0) * misfit).argmin(axis=0)]
            weights = 1.0 / (sigma[:, None] ** 2 + own + squared / _HALF_WEIGHT_SIGMAS**2)
            information = (weights[:, None] * rotations) @ rotations.T + ridge
            lines = np.linalg.solve(information, ((weights * measured_lateral) @ rotations.T)[..., None])[..., 0]
        now = np.concatenate([[1.0], rotation])
        return lines @ now, sigma**2 + np.linalg.solve(information, np.tile(now, (2, 1))[..., None])[..., 0] @ now
