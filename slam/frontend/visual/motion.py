"""Motions measured by optical flow: relative poses whose length may be measured separately, paths, history and noise.

A step is from a frame to a later one: usually the next, but it may also cross a gap. The links of a drive are
consecutive steps from the first frame to the last; where no step was measured, a link is to the next frame.

The covariance of corners holds for an ideal pinhole. Time stamps, the mount and the lens add errors, which grow with
the camera's rotation jitter and the residual of a step to its neighbours. So the sigmas of each step are inflated by
ratios of the part of these that the noise of corners does not explain, estimated from the drive without ground truth.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from slam.frames import Ends, RelativePose
from slam.geometry.multiview import UnitRelativePose
from slam.geometry.robust import MAD_TO_SIGMA, mad_sigma
from slam.geometry.se3 import FloatArray, invert

_LEAST_RELATIVE_SIGMA = 1e-3
# of the history
AXIS_SIGMA = float(np.deg2rad(8.0))  # least one of the direction of motion, radians
_STEPS_KEPT = 100
_LEAST_STEPS = 10
_SUDDEN_SHARE = 2.0 / 3.0
_SHARES = 10
_SPEEDS = 3
# of a car, in camera heights: 10 m/s2 at 1.65 m
_MOST_ACCELERATION = 6.0
_LENGTH_RELATIVE_SIGMA = 0.1
# sigmas over the jitter and over the residual, by Student's t on KITTI 00 and five simulated drives; ratios of other
# drives cover no better (docs/design/noise-and-the-pose-graph.md)
JITTER_ROTATION, JITTER_DIRECTION = 0.33, 8.5
NEIGHBOUR_ROTATION, NEIGHBOUR_DIRECTION = 0.25, 1.0
_NEIGHBOUR = np.repeat([NEIGHBOUR_ROTATION, NEIGHBOUR_DIRECTION], 3)
_LEAST_DIFFERENCES = 20
# a third difference of white noise has 1 + 9 + 9 + 1 times its variance
_THIRD_DIFFERENCE = np.sqrt(20.0)
# residual to the prediction by neighbours under white noise, sigmas
_NEIGHBOUR_RESIDUAL_OF_NOISE = 1.5


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
        """Sigmas ``(6,)`` of rotation and direction by the corners' own covariance, of a triangulated motion."""
        assert self.covariance is not None
        return np.asarray(np.sqrt(np.diag(self.covariance)))

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
            self.relative_pose,
            T_from_to=T_previous_current,
            sigmas=sigmas,
            correlated_sigmas=correlated_sigmas,
        )


@dataclass(frozen=True)
class RelativeRotation:
    """The rotation from one frame to another some steps later, measured on these two images alone.

    ``R_to_from`` ``(3, 3)`` takes points of the earlier camera to the axes of the later one; ``sigmas`` ``(3,)`` are
    those of its rotation vector in the later camera, radians.
    """

    ends: Ends
    R_to_from: FloatArray
    sigmas: FloatArray


def pose_sigmas(
    T_previous_current: FloatArray, of_unit_pose: FloatArray, length_relative_sigma: float
) -> FloatArray:
    """Sigmas ``(6,)`` of a pose in the current camera, where GTSAM perturbs.

    By those ``of_unit_pose`` ``(6,)``, its rotation and direction in radians, and by that of its length.
    """
    along = np.abs(invert(T_previous_current)[:3, 3])
    length = float(np.linalg.norm(along))
    translation = np.hypot(length * of_unit_pose[3:], length_relative_sigma * along)
    return np.concatenate(
        [of_unit_pose[:3], np.maximum(translation, _LEAST_RELATIVE_SIGMA * length)]
    )


# every motion that image geometry measured, kept once under its two frames, in the order in which they were measured
Steps = Mapping[Ends, Motion]


def triangulated(steps: Steps) -> dict[Ends, Motion]:
    """The steps whose length is free."""
    return {ends: motion for ends, motion in steps.items() if motion.is_triangulated}


def shortest_by_start(steps: Iterable[Ends]) -> dict[int, Ends]:
    """The shortest step from each frame, by that frame."""
    shortest: dict[int, Ends] = {}
    for ends in sorted(steps):
        shortest.setdefault(ends[0], ends)
    return shortest


def path_between(by_start: Mapping[int, Ends], first: int, last: int) -> list[Ends] | None:
    """Consecutive steps from a frame to a later one; None where one is missing."""
    path: list[Ends] = []
    while first < last:
        if first not in by_start:
            return None
        path.append(by_start[first])
        first = path[-1][1]
    return path if first == last else None


def links(steps: Iterable[Ends], frames: int) -> list[Ends]:
    """Consecutive steps from frame 0 to the last one; from a frame without a step, to the next frame."""
    by_start = shortest_by_start(steps)
    found: list[Ends] = []
    frame = 0
    while frame < frames - 1:
        found.append(by_start.get(frame, (frame, frame + 1)))
        frame = found[-1][1]
    return found


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
        return known and inlier_ratio < _SUDDEN_SHARE * float(np.median(self.inlier_ratios))

    def is_possible_speed(self, speed: float, seconds: float) -> bool | None:
        """Whether a car can have this speed after a step of so many seconds; None where speeds are unknown.

        Lengths by learned depth have a relative error of their own, three sigmas of which are granted.
        """
        if len(self.speeds) < _SPEEDS or not np.isfinite([*self.speeds, speed]).all():
            return None
        usual = float(np.median(self.speeds))
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
        axis = axis / max(float(np.linalg.norm(axis)), 1e-9)
        spread = mad_sigma(np.arccos(np.clip(directions @ axis, -1.0, 1.0)))
        return MotionPrior(axis, float(np.hypot(AXIS_SIGMA, spread)))


def step_noise(motions: Mapping[Ends, Motion], frames: int) -> dict[Ends, FloatArray]:
    """The noise of each triangulated step of a drive besides that of the corners, which adds in squares.

    Sigmas ``(6,)`` in radians are of rotation, then of the direction of the earlier camera as the later one sees it,
    where GTSAM perturbs; along it there is no error.

    Args:
        motions: the triangulated steps; lengths are not used.
        frames: of the drive.
    """
    if not motions:
        return {}
    place = {ends: row for row, ends in enumerate(links(motions, frames)) if ends in motions}
    values, own = np.full((2, max(place.values()) + 1, 6), np.nan)  # by their order in the drive
    for ends, row in place.items():
        T_previous_current = motions[ends].relative_pose.T_from_to
        towards = invert(T_previous_current)[:3, 3]
        values[row, :3] = Rotation.from_matrix(T_previous_current[:3, :3]).as_rotvec()
        values[row, 3:] = towards / max(float(np.linalg.norm(towards)), 1e-12)
        own[row] = motions[ends].corner_sigmas
    jitter = _unexplained(rotation_jitter(values[:, :3]), np.nanmedian(own[:, :3], axis=0))
    residual = _unexplained(neighbour_residual(values), _NEIGHBOUR_RESIDUAL_OF_NOISE * own)
    across = np.sqrt(np.maximum(1.0 - values[:, 3:] ** 2, 0.0))
    by_jitter = np.hstack(
        [
            np.tile(JITTER_ROTATION * jitter, (len(values), 1)),
            JITTER_DIRECTION * np.linalg.norm(jitter) * across,
        ]
    )
    noise = np.hypot(by_jitter, _NEIGHBOUR * residual)
    return {ends: noise[row] for ends, row in place.items()}


def rotation_jitter(rotations: FloatArray) -> FloatArray:
    """Sigmas ``(3,)``, radians, of the part of the steps' rotation vectors that no smooth motion explains.

    Third differences remove any rotation that changes evenly; their median is robust to single jumps. Zero with few
    steps. The vectors ``(S, 3)`` are in the order of the drive, NaN where unknown.
    """
    third = rotations[3:] - 3 * rotations[2:-1] + 3 * rotations[1:-2] - rotations[:-3]
    third = third[np.isfinite(third).all(axis=1)]
    if len(third) < _LEAST_DIFFERENCES:
        return np.zeros(3)
    return np.asarray(MAD_TO_SIGMA * np.median(np.abs(third), axis=0) / _THIRD_DIFFERENCE)


def neighbour_residual(values: FloatArray) -> FloatArray:
    """Absolute residual ``(S, D)`` of each step's value to the prediction by its neighbours, 0 without neighbours.

    Predicted by the two steps before, by the two after, and by one on each side; the median of these is robust
    to one bad neighbour. Values are in the order of the drive, NaN where unknown.
    """
    padded = np.pad(values, ((2, 2), (0, 0)), constant_values=np.nan)
    earlier, before, after, later = (padded[n : n + len(values)] for n in (0, 1, 3, 4))
    predicted = np.array([0.5 * before + 0.5 * after, 2.0 * before - earlier, 2.0 * after - later])
    predicted[0] = np.where(np.isnan(predicted).all(axis=0), values, predicted[0])
    known = np.isfinite(values[:, 0])
    residual = np.full_like(values, np.nan)
    residual[known] = np.abs(values[known] - np.nanmedian(predicted[:, known], axis=0))
    return residual


def _unexplained(seen: FloatArray, known: FloatArray) -> FloatArray:
    """The part of a deviation ``(D,)`` that known sigmas ``(D,)`` do not explain."""
    return np.asarray(np.sqrt(np.maximum(seen**2 - known**2, 0.0)))
