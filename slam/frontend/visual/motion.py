"""A motion measured by optical flow: a relative pose whose length may be measured separately."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam.frames import Ends, RelativePose
from slam.geometry.se3 import FloatArray, invert

_LEAST_RELATIVE_SIGMA = 1e-3


@dataclass(frozen=True)
class Motion:
    """A measured ``relative_pose``, its length by learned depth, unscaled.

    Where corners alone gave rotation and direction, ``covariance`` ``(6, 6)`` is that of both in this order, in the
    later camera, radians, and ``length_ratio`` is the log of the length over that of the step before, by points that
    both triangulated, with its sigma; else None. ``seconds`` passed between the frames. ``support`` is the share of the
    earlier frame's corners that were found again and fit the motion.
    """

    relative_pose: RelativePose
    covariance: FloatArray | None = None
    length_ratio: tuple[float, float] | None = None
    seconds: float = np.nan
    support: float = np.nan

    @property
    def ends(self) -> Ends:
        """Both frames."""
        return self.relative_pose.ends

    @property
    def is_triangulated(self) -> bool:
        """Whether corners alone gave rotation and direction, so that the length is free."""
        return self.covariance is not None

    @property
    def length_unscaled(self) -> float:
        """Length of the translation, in the unit of learned depth."""
        return float(np.linalg.norm(self.relative_pose.T_from_to[:3, 3]))

    @property
    def corner_sigmas(self) -> FloatArray:
        """Sigmas ``(6,)`` of rotation and direction by the corners' own covariance.

        Raises:
            ValueError: its direction was not measured separately from its length.
        """
        if self.covariance is None:
            raise ValueError(f"a motion by {self.relative_pose.source} has no separate noise of its direction")
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def with_pose(self, T_from_to: FloatArray) -> Motion:
        """The same with another pose ``(4, 4)``."""
        return replace(self, relative_pose=replace(self.relative_pose, T_from_to=T_from_to))

    def with_length(
        self, length: float, relative_sigma: float, relative_correlated_sigma: float, noise: FloatArray
    ) -> RelativePose:
        """The same rotation and direction with another length, and noise besides that of the corners.

        Args:
            length: in any unit, that of the result.
            relative_sigma: of the length.
            relative_correlated_sigma: of independent errors that add up along the steps as those of the lengths do.
            noise: sigmas ``(6,)`` of rotation and direction, added in squares to those of the corners.
        """
        T_previous_current = self.relative_pose.T_from_to.copy()
        T_previous_current[:3, 3] *= length / self.length_unscaled
        of_unit_pose = np.hypot(self.corner_sigmas, noise)
        sigmas, correlated_sigmas = (
            pose_sigmas(T_previous_current, of_unit_pose, sigma)
            for sigma in (relative_sigma, relative_correlated_sigma)
        )
        return replace(
            self.relative_pose, T_from_to=T_previous_current, sigmas=sigmas, correlated_sigmas=correlated_sigmas
        )


@dataclass(frozen=True)
class RelativeRotation:
    """The rotation from one frame to another some steps later, measured on these two images alone.

    ``R_to_from`` ``(3, 3)`` takes points of the earlier camera to the axes of the later one; ``sigmas`` ``(3,)`` are
    those of its rotation vector in the later camera, radians.
    """

    from_index: int
    to_index: int
    R_to_from: FloatArray
    sigmas: FloatArray

    @property
    def ends(self) -> Ends:
        """Both frames."""
        return self.from_index, self.to_index


def pose_sigmas(T_previous_current: FloatArray, of_unit_pose: FloatArray, length_relative_sigma: float) -> FloatArray:
    """Sigmas ``(6,)`` of a pose in the current camera, where GTSAM perturbs.

    Args:
        T_previous_current: the pose ``(4, 4)``.
        of_unit_pose: sigmas ``(6,)`` of its rotation and direction, radians.
        length_relative_sigma: of the length.
    """
    along = np.abs(invert(T_previous_current)[:3, 3])
    length = float(np.linalg.norm(along))
    translation = np.hypot(length * of_unit_pose[3:], length_relative_sigma * along)
    return np.concatenate([of_unit_pose[:3], np.maximum(translation, _LEAST_RELATIVE_SIGMA * length)])
