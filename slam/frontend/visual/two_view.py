"""The motion between two views from corners, learned depth and the motion prior of the drive.

Corners alone are ambiguous (``docs/design/visual-front-end.md``). Two further measurements resolve
this: the shift of each corner along its epipolar line, which learned depth predicts too; and the
usual direction of motion. Residuals of corners are across and along these lines.

A car that drives along keeps its corners on their epipolar lines. Learned depth is believed against
them only about a region as an object has it: connected, of one motion, and without the majority of
the road; and about all such regions together only where they do not hold the majority of the
image's parallax.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import cv2
import numpy as np
from scipy import ndimage

from slam.frontend.visual.history import AXIS_SIGMA, MotionHistory, MotionPrior
from slam.geometry.multiview import (
    UnitRelativePose,
    cross,
    parallax_px,
    triangulated_depth,
    unit_pose_by_essential,
    unit_pose_by_pnp,
)
from slam.geometry.robust import mad_sigma, weighted_median
from slam.geometry.se3 import BoolArray, FloatArray, compose, rotation_matrix

_ITERATIONS = 10
# over-relaxation: reweighting alone converges by half of the distance an iteration
_OVERSTEP = 1.4
_CONVERGED = 3e-5  # radians: the least sigma of a rotation
_LEAST_POINTS = 8
_RESECTION_PX = 2.0
# corners of a motion over those of the best one, from which on it may be the right one
_COMPARABLE_SUPPORT = 0.6
# inlier bound along the epipolar line, sigmas
_ALONG_SIGMAS = 2.5
# parallax of a corner that is an inlier against its learned depth, in sigmas of the corners' noise:
# triangulated to a twentieth, four times as well as learned depth is known at best
_PARALLAX_SIGMAS = 20.0
# an outlier costs as much as this half-squared residual
_OUTLIER_COST = 3.0
# errors of learned depth are correlated in patches: its sigma is widened by this near a known
# motion
_PATCH_WIDENING = 3.0
# errors of neighbouring corners are correlated: sigmas of independent ones are widened by this
CORNER_CORRELATION = 2.0
_ALONG_PX = 0.4  # corner noise along the epipolar line, pixels, besides that of learned depth
_EARLY_EXIT_INLIER_RATIO = 0.75  # inlier ratio at which RANSAC stops early
INLIER_PX = 0.6  # largest epipolar distance of an inlier, pixels
DEPTH_RELATIVE_SIGMA = 0.2  # least relative sigma of learned depth along an epipolar line
# hat(w) row by row, by each component of w
_HATS = np.array(
    [[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]],
    float,
)
# side of the cells that connect corners to a region, pixels: some two spacings of corners
_REGION_CELL_PX = 24.0
_LARGEST_SHARE = 0.5
# largest deviation of the corners of a region from its own motion, over that motion
_CONSISTENCY = 0.5


@dataclass(frozen=True)
class Matches:
    """``M`` corners in two images: rays ``(M, 3)`` with z = 1 in both, learned ``depth_previous`` ``(M,)`` or NaN.

    Learned depth is without its bias and has the relative ``depth_sigma`` ``(M,)``; by it the
    corners ``on_road`` ``(M,)`` lie at the height of the road. The motion that most of those with
    ``votes`` ``(M,)`` agree on is chosen. ``focal_px`` is the focal length, pixels.
    """

    rays_previous: FloatArray
    rays_current: FloatArray
    depth_previous: FloatArray
    depth_sigma: FloatArray
    on_road: BoolArray
    votes: BoolArray
    focal_px: float

    @cached_property
    def residuals(self) -> Residuals:
        """Those of the corners under any motion."""
        return Residuals(self.rays_previous, self.rays_current, self.depth_previous, self.focal_px)

    def length(self, unit_pose: UnitRelativePose) -> float | None:
        """Length in the unit of learned depth, by corners with parallax near their epipolar lines; None with few.

        Without learned depth the length does not matter.
        """
        if not np.isfinite(self.depth_previous).any():
            return 1.0
        ratios, shift_px = self.ratios(unit_pose)
        return weighted_median(ratios, shift_px) if len(ratios) >= _LEAST_POINTS else None

    def ratios(self, unit_pose: UnitRelativePose) -> tuple[FloatArray, FloatArray]:
        """Learned over triangulated depth of corners with parallax near their epipolar lines, and that parallax."""
        distance, _ = self.residuals.across(unit_pose, tangent_of(unit_pose.direction))
        depth = triangulated_depth(self.rays_previous, self.rays_current, unit_pose)
        rotation = unit_pose.R_current_previous
        shift_px = parallax_px(self.rays_previous, self.rays_current, rotation, self.focal_px)
        usable = (np.abs(distance) < INLIER_PX) & (depth > 0) & (shift_px > 1.0)
        usable &= np.isfinite(self.depth_previous)
        return np.asarray(self.depth_previous[usable] / depth[usable]), np.asarray(shift_px[usable])


@dataclass(frozen=True)
class TwoViewEstimate:
    """A ``unit_pose`` with its noise and support.

    ``covariance`` ``(6, 6)``: rotation then direction, both in the current camera, radians.
    ``noise_px`` is the sigma of corners about their epipolar lines. ``inliers`` ``(M,)`` marks the
    corners that fit it, ``agreeing`` ``(M,)`` those whose learned depth fits it too.
    """

    unit_pose: UnitRelativePose
    covariance: FloatArray
    noise_px: float
    inliers: BoolArray
    agreeing: BoolArray


def estimate(matches: Matches, history: MotionHistory, seed: int = 0) -> TwoViewEstimate | None:
    """Rotation and direction of the next motion.

    Args:
        matches: corners in both images.
        history: of the steps before, of which the last motion and the usual direction are tried.
        seed: of RANSAC.

    Returns:
        None without a consensus.
    """
    votes, prior, least = matches.votes, history.prior(), _EARLY_EXIT_INLIER_RATIO
    usual = _refined(matches, history.last, prior)
    if usual is not None and usual.agreeing[votes].mean() >= least:
        return usual
    first, second = matches.rays_previous[votes], matches.rays_current[votes]
    depth = matches.depth_previous[votes]
    tolerance = _RESECTION_PX / matches.focal_px
    by_points = cache(lambda: unit_pose_by_pnp(first, second, depth, tolerance, seed))
    proposed = unit_pose_by_essential(first, second, INLIER_PX / matches.focal_px, seed)
    if history.last is None and proposed is not None:
        matches = _with_first_sigma(matches, [proposed, by_points()])
    best = _refined(matches, proposed, prior)
    candidates = [usual, best]
    if best is None or best.agreeing[votes].mean() < least:
        candidates.append(_refined(matches, by_points(), prior))
    estimates = [candidate for candidate in candidates if candidate is not None]
    if not estimates:
        return None
    return max(estimates, key=lambda candidate: _support(candidate, votes, prior))


def refined(matches: Matches, start: UnitRelativePose) -> TwoViewEstimate | None:
    """The motion refined from a well-known ``start``.

    Learned depth has a small weight: it is needed only to choose between motions.
    """
    matches = replace(matches, depth_sigma=_PATCH_WIDENING * matches.depth_sigma)
    return _refined(matches, start, MotionPrior(start.direction, AXIS_SIGMA))


def _refined(
    matches: Matches, start: UnitRelativePose | None, prior: MotionPrior
) -> TwoViewEstimate | None:
    """Gauss-Newton with Cauchy weights over rotation, direction and the length in the unit of learned depth.

    Across its epipolar line a corner has the noise of the image, along it that of learned depth. A
    corner with parallax is an inlier whatever its learned depth says: its own shift is the better
    measurement. Without parallax the corner is far away or moves along with the camera, which
    learned depth alone can tell apart.
    """
    if start is None:
        return None
    residuals, begin = matches.residuals, matches.length(start)
    if begin is None:
        return None
    unit_pose, length = start, begin
    known = np.isfinite(matches.depth_previous)
    for iteration in range(_ITERATIONS):
        tangent = tangent_of(unit_pose.direction)
        across, by_motion = residuals.across(unit_pose, tangent)
        along, by_all, shift_px = residuals.along(unit_pose, length, tangent)
        near = np.abs(across) < INLIER_PX
        sigma = max(mad_sigma(across[near]), 1e-3 * INLIER_PX) if near.any() else INLIER_PX
        sigma_along = np.hypot(_ALONG_PX, matches.depth_sigma * shift_px)
        seen_px = shift_px - along
        agreeing, inliers = _inliers(matches, near, shift_px, seen_px, _PARALLAX_SIGMAS * sigma)
        if inliers.sum() < _LEAST_POINTS:
            return None
        weights = inliers / (1.0 + (across / (2.0 * sigma)) ** 2)
        weights_along = (
            known * weights / (sigma_along**2 * (1.0 + (along / (2.0 * sigma_along)) ** 2))
        )
        weights = weights / sigma**2
        normal = (weights_along * by_all) @ by_all.T + 1e-9 * np.eye(6)
        normal[:5, :5] += (weights * by_motion) @ by_motion.T
        gradient = by_all @ (weights_along * along)
        gradient[:5] += by_motion @ (weights * across)
        deviation = (
            unit_pose.direction - np.copysign(1.0, prior.axis @ unit_pose.direction) * prior.axis
        )
        normal[3:5, 3:5] += np.eye(2) / prior.axis_sigma**2
        gradient[3:5] += tangent.T @ deviation / prior.axis_sigma**2
        step = np.asarray(-_OVERSTEP * np.linalg.solve(normal, gradient), np.float64)
        if iteration == _ITERATIONS - 1 or np.abs(step[:5]).max() < _CONVERGED:
            break
        direction = unit_pose.direction + tangent @ step[3:5]
        R_current_previous = compose(rotation_matrix(step[:3]), unit_pose.R_current_previous)
        unit_pose = UnitRelativePose(R_current_previous, direction / np.linalg.norm(direction))
        length = max(length + float(step[5]), 0.2 * length)
    lift = np.zeros((6, 5))
    lift[:3, :3], lift[3:, 3:] = np.eye(3), tangent
    covariance = lift @ np.linalg.inv(normal)[:5, :5] @ lift.T
    return TwoViewEstimate(unit_pose, covariance, sigma, inliers, agreeing)


def _inliers(
    matches: Matches, near: BoolArray, shift_px: FloatArray, seen_px: FloatArray, parallax_px: float
) -> tuple[BoolArray, BoolArray]:
    """Which corners near their epipolar lines fit learned depth ``(M,)``, and which are inliers ``(M,)``.

    The majority of the parallax in the image decides on the length by which learned depth is
    compared, not the majority of corners: those far away are many at times, and their depth is the
    least certain. Shifts ``(M,)`` along the lines are ``shift_px`` by learned depth and
    ``seen_px``; larger ones than ``parallax_px`` are inliers against it.
    """
    known = np.isfinite(matches.depth_previous)
    measured = near & known & (seen_px > 1.0) & (shift_px > 0)
    by_parallax = (
        weighted_median(seen_px[measured] / shift_px[measured], seen_px[measured])
        if measured.any()
        else 1.0
    )
    expected_px = by_parallax * shift_px
    tolerance_px = _ALONG_SIGMAS * np.hypot(_ALONG_PX, matches.depth_sigma * expected_px)
    agreeing = near & (~known | (np.abs(seen_px - expected_px) < tolerance_px))
    contradicting = near & ~agreeing
    pixels = matches.focal_px * matches.rays_previous[:, :2]
    moving = moving_corners(pixels, matches.on_road, agreeing, contradicting, expected_px, seen_px)
    return agreeing, agreeing | (contradicting & ~moving & (seen_px > parallax_px))


def _with_first_sigma(matches: Matches, motions: Sequence[UnitRelativePose | None]) -> Matches:
    """Until the drive has told the error of learned depth, it is the least under a motion that most corners fit."""
    ratios = [matches.ratios(motion)[0] for motion in motions if motion is not None]
    least = max(_LEAST_POINTS, _COMPARABLE_SUPPORT * max(map(len, ratios), default=0))
    logarithms = [np.log(of_motion) for of_motion in ratios if len(of_motion) >= least]
    error = min(
        (mad_sigma(logarithm - np.median(logarithm)) for logarithm in logarithms), default=0.0
    )
    return replace(matches, depth_sigma=np.maximum(matches.depth_sigma, error))


def _support(candidate: TwoViewEstimate, votes: BoolArray, prior: MotionPrior) -> float:
    """Number of votes of inliers that agree with learned depth, less the cost of leaving the usual axis."""
    deviation = prior.deviation(candidate.unit_pose.direction)
    return float(candidate.agreeing[votes].sum()) - 0.5 * deviation**2 / _OUTLIER_COST


class Residuals:
    """Residuals of ``M`` corners in two images, in pixels.

    Derivatives ``(5, M)`` are by rotation, in the current camera, and by the direction along both
    axes of its ``tangent`` ``(3, 2)``; a sixth is by the length. Arrays are coordinate-major, which
    is several times faster.
    """

    def __init__(
        self,
        rays_previous: FloatArray,
        rays_current: FloatArray,
        depth_previous: FloatArray,
        focal_px: float,
    ) -> None:
        """From rays ``(M, 3)`` with z = 1, and learned depths ``(M,)`` in the earlier camera or NaN."""
        self._previous = np.ascontiguousarray(rays_previous.T)
        self._current = np.ascontiguousarray(rays_current.T)
        # every bilinear form of the rays is a matrix times one of these
        self._both = _products(self._current, self._previous)
        self._previous_twice = _products(self._previous, self._previous)
        self._current_twice = _products(self._current, self._current)
        self._inverse_depth = np.where(np.isfinite(depth_previous), 1.0 / depth_previous, 0.0)
        self._focal_px = focal_px

    def across(
        self, unit_pose: UnitRelativePose, tangent: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Sampson distances ``(M,)`` and their derivatives ``(5, M)`` (Hartley and Zisserman 2004, Eq. 11.9).

        The gradient's norm changes with the motion too. Held fixed, as reweighted least squares do,
        it biases the motion by the square of the corners' noise.
        """
        # E = hat(t) R and its five derivatives
        essential = np.empty((6, 3, 3))
        essential[0] = hat = (unit_pose.direction @ _HATS).reshape(3, 3)
        essential[1:4] = hat @ _HATS.reshape(3, 3, 3)
        essential[4:] = (tangent.T @ _HATS).reshape(2, 3, 3)
        essential = essential @ unit_pose.R_current_previous
        algebraic = essential.reshape(6, 9) @ self._both
        # squared lengths of E x and E^T x' without their last coefficients, and half their
        # derivatives
        lines_current = essential[:, :2].swapaxes(1, 2) @ essential[0, :2]
        lines_previous = essential[:, :, :2] @ essential[0, :, :2].T
        squares = lines_current.reshape(6, 9) @ self._previous_twice
        squares += lines_previous.reshape(6, 9) @ self._current_twice
        gradient = np.sqrt(np.maximum(squares[0], 1e-18))
        distance = algebraic[0] / gradient
        slopes = (algebraic[1:] - distance / gradient * squares[1:]) / gradient
        return distance * self._focal_px, slopes * self._focal_px

    def along(
        self, unit_pose: UnitRelativePose, length: float, tangent: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Distances ``(M,)`` along the epipolar lines from the points predicted by learned depth.

        Also their derivatives ``(6, M)``, and the shift along the line predicted by learned depth
        ``(M,)``.
        """
        rotated = unit_pose.R_current_previous @ self._previous
        points = (
            rotated + (length * unit_pose.direction)[:, None] * self._inverse_depth
        )  # over depth
        ahead = np.maximum(points[2], 1e-6)
        expected = points[:2] / ahead
        line = expected - rotated[:2] / np.maximum(rotated[2], 1e-6)
        shift = np.sqrt((line**2).sum(axis=0))
        line /= np.maximum(shift, 1e-9)
        distance = ((expected - self._current[:2]) * line).sum(axis=0)
        by_point = np.concatenate([line, -(line * expected).sum(axis=0)[None]]) / ahead
        slopes = np.empty((6, len(distance)))
        slopes[:3] = cross(rotated, by_point)
        slopes[3:5] = tangent.T @ by_point * (length * self._inverse_depth)
        slopes[5] = unit_pose.direction @ by_point * self._inverse_depth
        return distance * self._focal_px, slopes * self._focal_px, shift * self._focal_px


def _products(a: FloatArray, b: FloatArray) -> FloatArray:
    """Outer products ``(9, M)`` of vectors ``(3, M)``."""
    return (a[:, None] * b).reshape(9, -1)


def tangent_of(direction: FloatArray) -> FloatArray:
    """Two unit axes ``(3, 2)`` orthogonal to a ``direction`` ``(3,)`` and each other (Duff et al. 2017)."""
    x, y, z = direction.tolist()
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[1.0 + sign * x * x * a, b], [sign * b, sign + y * y * a], [-sign * x, -y]])


def moving_corners(
    pixels: FloatArray,
    on_road: BoolArray,
    agreeing: BoolArray,
    contradicting: BoolArray,
    expected_px: FloatArray,
    seen_px: FloatArray,
) -> BoolArray:
    """Which of the contradicting corners ``(M,)`` lie in a region that moves.

    Args:
        pixels: ``(M, 2)``, of any origin.
        on_road: corners that learned depth puts on the road ``(M,)``.
        agreeing: corners on their epipolar lines whose shift along them is as learned depth has it
            ``(M,)``.
        contradicting: those on their lines whose shift is another ``(M,)``.
        expected_px: the shift by learned depth ``(M,)``.
        seen_px: the shift along the line ``(M,)``, negative away from it.
    """
    moving = np.zeros(len(pixels), dtype=bool)
    if not contradicting.any():
        return moving
    cells = np.floor(
        (pixels[contradicting] - pixels[contradicting].min(axis=0)) / _REGION_CELL_PX
    ).astype(np.int64)
    occupied = np.zeros(tuple(cells.max(axis=0) + 1), np.uint8)
    occupied[tuple(cells.T)] = 1
    count, labels = cv2.connectedComponents(occupied, connectivity=8)
    region = labels[tuple(cells.T)]
    motion = 1.0 - seen_px[contradicting] / np.maximum(expected_px[contradicting], 1e-3)
    parallax = np.where(agreeing | contradicting, np.abs(seen_px), 0.0)
    on_road_px = np.bincount(region, (parallax * on_road)[contradicting], count)
    is_most_of_road = on_road_px > _LARGEST_SHARE * parallax[on_road].sum()
    regions = np.arange(count)
    middle = ndimage.median(motion, region, regions)
    scatter = ndimage.median(np.abs(motion - middle[region]), region, regions)
    moving[contradicting] = (~is_most_of_road & (scatter < _CONSISTENCY * np.abs(middle)))[region]
    is_most = parallax[moving].sum() > _LARGEST_SHARE * parallax.sum()
    return np.zeros_like(moving) if is_most else moving
