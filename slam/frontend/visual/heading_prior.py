"""A vehicle goes where it is steered: its direction of motion follows from its turn, up to a fraction of a degree.

What corners say of a direction and of a turn is bound together: with few of them, a camera that slides to the right can
hardly be told from one that turns to the left, and the errors of both are correlated by 0.8
(``docs/design/visual-front-end.md``). How
direction and turn of this drive belong together is seen from the steps before; whatever is known of the direction then
mends the turn. On a camera that goes anywhere the relation is loose, and says nothing.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from scipy.spatial.transform import Rotation

from slam.frontend.visual.epipolar import UnitRelativePose
from slam.se3 import FloatArray
from slam.storage.serialisation import Learner

_REMEMBERED = 200
_LEAST_REMEMBERED = 20
_REWEIGHTINGS = 4
_STUDENT_FREEDOM = 4.0
_WIDEST_SIGMA = np.deg2rad(20.0)
_SIGMAS_TRIED = 24
# how far the direction may follow a turn, before any is seen
_SLOPE_SIGMA = 2.0
# an innovation of so many sigmas has half its weight
_HALF_WEIGHT_SIGMAS = 2.0


class HeadingPrior(Learner):
    """How the turns and directions of one drive belong together, learned from one step after the other."""

    remembers = ("_turns", "_directions", "_covariances")

    def __init__(self, least_sigma: float) -> None:
        """Nothing seen yet.

        Args:
            least_sigma: of the direction that a turn foretells, radians.
        """
        self._sigmas = np.geomspace(least_sigma, max(_WIDEST_SIGMA, least_sigma), _SIGMAS_TRIED)
        self._turns: deque[FloatArray] = deque(maxlen=_REMEMBERED)
        self._directions: deque[FloatArray] = deque(maxlen=_REMEMBERED)
        self._covariances: deque[FloatArray] = deque(maxlen=_REMEMBERED)

    def fused(self, unit_pose: UnitRelativePose, covariance: FloatArray) -> tuple[UnitRelativePose, FloatArray]:
        """A measurement joined with what the turns before say of it; the measurement itself is then remembered.

        One step of a Kalman filter, with less weight for what does not fit.

        Args:
            heading: measured.
            covariance: its own ``(6, 6)``, rotation then direction, both in the current camera, radians.

        Returns:
            The same of both together.
        """
        turn = Rotation.from_matrix(unit_pose.R_current_previous).as_rotvec()
        joined = unit_pose, covariance
        if len(self._turns) >= _LEAST_REMEMBERED:
            joined = self._joined(unit_pose, covariance, turn)
        self._turns.append(turn)
        self._directions.append(unit_pose.direction)
        self._covariances.append(covariance[3:, 3:])
        return joined

    def _joined(
        self, unit_pose: UnitRelativePose, covariance: FloatArray, turn: FloatArray
    ) -> tuple[UnitRelativePose, FloatArray]:
        axis = np.median(self._directions, axis=0)
        aside = np.linalg.svd(axis[None])[2][1:].T  # (3, 2)
        if axis @ unit_pose.direction <= 0:  # it reverses
            return unit_pose, covariance
        foretold, variance = self._foretold(aside, turn)
        to_direction = covariance[:, 3:] @ aside  # (6, 2)
        innovation = foretold - aside.T @ unit_pose.direction
        information = np.linalg.inv(aside.T @ to_direction[3:] + np.diag(variance))
        surprise = float(innovation @ information @ innovation)
        gain = to_direction @ information / (1.0 + surprise / _HALF_WEIGHT_SIGMAS**2)
        mended = gain @ innovation
        R_current_previous = Rotation.from_rotvec(mended[:3]).as_matrix() @ unit_pose.R_current_previous
        direction = unit_pose.direction + mended[3:]
        left = covariance - gain @ to_direction.T
        return UnitRelativePose(R_current_previous, direction / np.linalg.norm(direction)), 0.5 * (left + left.T)

    def _foretold(self, aside: FloatArray, turn: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Both sideways components of the direction ``(2,)`` after a turn, and their variances ``(2,)``.

        A line through the turns seen, fitted by reweighting; how closely directions keep to it, beside their own
        errors, is what makes them most likely under Student's t.
        """
        turns = np.concatenate([np.ones((1, len(self._turns))), np.array(self._turns).T])  # (4, N)
        seen = aside.T @ np.array(self._directions).T  # (2, N)
        squares = (aside[:, None] * aside).reshape(9, 2)
        own = squares.T @ np.array(self._covariances).reshape(-1, 9).T
        variances = self._sigmas[:, None, None] ** 2 + own  # (S, 2, N)
        narrow = np.log(variances).sum(axis=2)
        lines = np.zeros((2, 4))
        lines[:, 0] = np.median(seen, axis=1)
        ridge = np.diag([0.0, *(3 * [_SLOPE_SIGMA**-2.0])])
        for _ in range(_REWEIGHTINGS):
            squared = (seen - lines @ turns) ** 2
            surprise = np.log(1.0 + squared / (_STUDENT_FREEDOM * variances)).sum(axis=2)
            sigma = self._sigmas[(narrow + (_STUDENT_FREEDOM + 1.0) * surprise).argmin(axis=0)]
            weights = 1.0 / (sigma[:, None] ** 2 + own + squared / _HALF_WEIGHT_SIGMAS**2)
            information = (weights[:, None] * turns) @ turns.T + ridge
            lines = np.linalg.solve(information, ((weights * seen) @ turns.T)[..., None])[..., 0]
        now = np.concatenate([[1.0], turn])
        return lines @ now, sigma**2 + np.linalg.solve(information, np.tile(now, (2, 1))[..., None])[..., 0] @ now
