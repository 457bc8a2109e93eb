"""Which of several estimates of a step the road, the steps before and a car's acceleration agree with.

Learned depth, the dynamic mask and the motion prior are learned from the steps before: one wrong step teaches them to
find the next one wrong too. So a step that loses a third of its inliers, or has a length that no car reaches, is
estimated again from corners alone, and the measurements that do not depend on them vote.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.frontend.visual.motion import Motion, MotionHistory
from slam.frontend.visual.two_view import Matches, TwoViewEstimate
from slam.geometry.epipolar import triangulated_depth
from slam.geometry.robust import mad_sigma, weighted_median
from slam.geometry.se3 import FloatArray

# largest log of a length over the same by the road or by triangulated points
_AGREEMENT = 0.25
_LEAST_ROAD_CORNERS = 8
_LEAST_COMMON = 12  # points by which two steps compare their lengths


@dataclass(frozen=True)
class TriangulatedPoints:
    """``M`` scene points that a step triangulated, by the identifiers of their tracks ``track_ids`` ``(M,)``.

    z-depths ``(M,)`` in both cameras are in units of the step's length, ``relative_sigma`` ``(M,)`` is that of both.
    """

    track_ids: NDArray[np.int64]
    depth_previous: FloatArray
    depth_current: FloatArray
    relative_sigma: FloatArray

    def length_ratio(self, earlier: TriangulatedPoints) -> tuple[float, float] | None:
        """Log of this step's length over that of an earlier one that ends where this begins, with its sigma.

        In the frame between, a point's depth is ``|t| z`` by either step; None with too few common points.
        """
        _, first, second = np.intersect1d(earlier.track_ids, self.track_ids, assume_unique=True, return_indices=True)
        if len(first) < _LEAST_COMMON:
            return None
        logarithms = np.log(earlier.depth_current[first] / self.depth_previous[second])
        weights = 1.0 / (earlier.relative_sigma[first] ** 2 + self.relative_sigma[second] ** 2)
        middle = weighted_median(logarithms, weights)
        deviation = mad_sigma(logarithms - middle)
        return middle, deviation / float(np.sqrt(len(first)))


@dataclass(frozen=True)
class Step:
    """A ``motion`` whose length learned depth gives, the two-view estimate behind it, and the points triangulated."""

    motion: Motion
    two_view: TwoViewEstimate
    points: TriangulatedPoints

    @property
    def inlier_ratio(self) -> float:
        """Share of the corners that fit."""
        return float(self.two_view.inliers.mean())

    def speed(self, height_unscaled: float | None, seconds: float) -> float:
        """Camera heights a second, NaN where the height is unknown."""
        if height_unscaled is None or seconds <= 0:
            return np.nan
        return self.motion.length_unscaled / height_unscaled / seconds


def most_credible(
    steps: Sequence[Step | None],
    matches: Matches,
    height_unscaled: float | None,
    seconds: float,
    history: MotionHistory,
) -> Step | None:
    """The step with most votes, the first of equal ones; None where more votes are against each than for it."""
    estimated = [step for step in steps if step is not None]
    balance = []
    for step in estimated:
        speed = step.speed(height_unscaled, seconds)
        votes = [history.is_possible_speed(speed, seconds), _fits_ratio(step, speed, history)]
        votes += [_fits_road(step, matches, height_unscaled), _fits_axis(step, history)]
        balance.append(sum(1 if vote else -1 for vote in votes if vote is not None))
    best = int(np.argmax(balance))
    return estimated[best] if balance[best] >= 0 else None


def _fits_ratio(step: Step, speed: float, history: MotionHistory) -> bool | None:
    """Whether points of this step and the one before have the ratio of lengths that learned depth has."""
    if step.motion.length_ratio is None or not history.speeds or not np.isfinite(speed / history.speeds[-1]):
        return None
    ratio, _ = step.motion.length_ratio
    return bool(abs(np.log(speed / history.speeds[-1]) - ratio) < _AGREEMENT)


def _fits_axis(step: Step, history: MotionHistory) -> bool | None:
    """Whether the direction is about the median of the last hundred steps, which a few wrong ones do not change."""
    prior = history.prior()
    if not np.isfinite(prior.axis_sigma):
        return None
    cosine = abs(float(prior.axis @ step.two_view.unit_pose.direction))
    return bool(np.arccos(min(cosine, 1.0)) < 3.0 * prior.axis_sigma)


def _fits_road(step: Step, matches: Matches, height_unscaled: float | None) -> bool | None:
    """Whether the corners on the road are triangulated at the camera's height below it."""
    road = matches.on_road & step.two_view.inliers
    if height_unscaled is None or road.sum() < _LEAST_ROAD_CORNERS:
        return None
    rays = matches.rays_previous[road]
    depth = triangulated_depth(rays, matches.rays_current[road], step.two_view.unit_pose)
    height = float(np.median(depth * rays[:, 1]))
    return bool(abs(np.log(max(height * step.motion.length_unscaled, 1e-9) / height_unscaled)) < _AGREEMENT)
