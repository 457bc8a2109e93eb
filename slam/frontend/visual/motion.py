"""Motions measured by optical flow: relative poses whose length may be measured apart.

A step is from a frame to a later one: usually the next, but it may also cross a gap. The links of a
drive are consecutive steps from the first frame to the last; where no step was measured, a link is
to the next frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from slam.frames import Ends, RelativePose
from slam.geometry.se3 import FloatArray, in_unit, invert, length_of

_LEAST_RELATIVE_SIGMA = 1e-3


@dataclass(frozen=True)
class Motion:
    """A measured ``relative_pose``, its length by learned depth, unscaled.

    Where corners alone gave rotation and direction, ``covariance`` ``(6, 6)`` is that of both in
    this order, in the later camera, radians, and ``length_ratio`` is the log of the length over
    that of the step before, by points that both triangulated, with its sigma; else None.
    ``seconds`` passed between the frames. ``support`` is the share of the earlier frame's corners
    that were found again and fit the motion.
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
        return length_of(self.relative_pose.T_from_to[:3, 3])

    @property
    def corner_sigmas(self) -> FloatArray:
        """Sigmas ``(6,)`` of rotation and direction by the corners' own covariance, of a triangulated motion."""
        assert self.covariance is not None
        return np.sqrt(np.diag(self.covariance))

    def with_length(
        self,
        length: float,
        relative_sigma: float,
        relative_correlated_sigma: float,
        noise: FloatArray,
    ) -> RelativePose:
        """The same rotation and direction with another length, and noise besides that of the corners.

        Args:
            length: in any unit, that of the result.
            relative_sigma: of the length.
            relative_correlated_sigma: of independent errors that add up along the steps as those of
                the lengths do.
            noise: sigmas ``(6,)`` of rotation and direction, added in squares to those of the
                corners.
        """
        T_previous_current = in_unit(self.relative_pose.T_from_to, length / self.length_unscaled)
        of_unit_pose = np.hypot(self.corner_sigmas, noise)
        return replace(
            self.relative_pose,
            T_from_to=T_previous_current,
            sigmas=pose_sigmas(T_previous_current, of_unit_pose, relative_sigma),
            correlated_sigmas=pose_sigmas(
                T_previous_current, of_unit_pose, relative_correlated_sigma
            ),
        )


@dataclass(frozen=True)
class RelativeRotation:
    """The rotation from one frame to another two steps later, measured on these two images alone.

    ``R_to_from`` ``(3, 3)`` takes points of the earlier camera to the axes of the later one;
    ``sigmas`` ``(3,)`` are those of its rotation vector in the later camera, radians.
    """

    R_to_from: FloatArray
    sigmas: FloatArray


def pose_sigmas(
    T_previous_current: FloatArray, of_unit_pose: FloatArray, length_relative_sigma: float
) -> FloatArray:
    """Sigmas ``(6,)`` of a pose in the current camera, where GTSAM perturbs.

    By those ``of_unit_pose`` ``(6,)``, its rotation and direction in radians, and by that of its
    length.
    """
    along = np.abs(invert(T_previous_current)[:3, 3])
    length = length_of(along)
    translation = np.hypot(length * of_unit_pose[3:], length_relative_sigma * along)
    return np.concatenate(
        [of_unit_pose[:3], np.maximum(translation, _LEAST_RELATIVE_SIGMA * length)]
    )


# every motion that image geometry measured, kept once under its two frames, in the order in which
# they were measured
Steps = Mapping[Ends, Motion]


def triangulated(steps: Steps) -> dict[Ends, Motion]:
    """The steps whose length is free."""
    return {ends: motion for ends, motion in steps.items() if motion.is_triangulated}


def links(steps: Iterable[Ends], frames: int) -> list[Ends]:
    """Consecutive steps from frame 0 to the last one; from a frame without a step, to the next frame."""
    by_start: dict[int, Ends] = {}
    for ends in sorted(steps):  # the shortest step from each frame
        by_start.setdefault(ends[0], ends)
    found: list[Ends] = []
    frame = 0
    while frame < frames - 1:
        found.append(by_start.get(frame, (frame, frame + 1)))
        frame = found[-1][1]
    return found
