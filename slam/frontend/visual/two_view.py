"""The motion between two views from corners, learned depth and the motion prior of the drive.

Corners alone are ambiguous: where most of them lie on a car that turns with the camera, its corners and distant ones
lie on the epipolar lines of a motion that neither made (``docs/design/visual-front-end.md``). Two further
measurements resolve this: the shift of each corner along its epipolar line, which learned depth predicts too; and the
usual direction of motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam.config import GeometryConfig
from slam.frontend.visual.epipolar import (
    UnitRelativePose,
    triangulated_depth,
    unit_pose_by_essential,
    unit_pose_by_pnp,
)
from slam.frontend.visual.motion_history import MotionHistory, MotionPrior, usual_error
from slam.frontend.visual.residuals import Residuals, tangent_of
from slam.robust import mad_sigma
from slam.se3 import FloatArray
from slam.storage.cache import Answer, GetOrCompute, Given, without_cache

_ITERATIONS = 10
# over-relaxation: reweighting alone converges by half of the distance an iteration
_OVERSTEP = 1.4
_CONVERGED = 1e-5
_LEAST_POINTS = 8
_LEAST_PROPOSING_WEIGHT = 0.2
_RESECTION_PX = 2.0
# inlier bound along the epipolar line, sigmas
_ALONG_SIGMAS = 2.5
# an outlier costs as much as this half-squared residual
_OUTLIER_COST = 3.0
# errors of learned depth are correlated in patches: its sigma is widened by this near a known motion
_PATCH_WIDENING = 3.0
# errors of neighbouring corners are correlated: sigmas of independent ones are widened by this
CORNER_CORRELATION = 2.0
_ALONG_PX = 0.4  # corner noise along the epipolar line, pixels, besides that of learned depth
_EARLY_EXIT_INLIER_RATIO = 0.75  # inlier ratio at which RANSAC stops early
INLIER_PX = 0.6  # largest epipolar distance of an inlier, pixels
_DIRECTION_PRIOR_SIGMA_DEG = 8.0  # least sigma of the motion prior on the translation direction, degrees
DEPTH_RELATIVE_SIGMA = 0.2  # least relative sigma of learned depth along an epipolar line


@dataclass(frozen=True)
class Matches:
    """``M`` corners in two images: rays ``(M, 3)`` with z = 1 in both, learned ``depth_previous`` ``(M,)`` or NaN.

    ``weights`` ``(M,)`` in (0, 1] are lower on dynamic objects.
    """

    rays_previous: FloatArray
    rays_current: FloatArray
    depth_previous: FloatArray
    weights: FloatArray


@dataclass(frozen=True)
class TwoViewEstimate:
    """A ``unit_pose`` with its noise and support.

    ``covariance`` ``(6, 6)``: rotation then direction, both in the current camera, radians.
    ``inliers`` ``(M,)`` marks the corners that fit it and their learned depth.
    """

    unit_pose: UnitRelativePose
    covariance: FloatArray
    inliers: NDArray[np.bool_]


class TwoViewEstimator:
    """Estimates the motions of one drive; stateless, the history is an argument."""

    def __init__(
        self,
        config: GeometryConfig,
        focal_px: float,
        get_or_compute: GetOrCompute = without_cache,
        seed: int = 0,
    ) -> None:
        self._config = config
        self._focal_px = focal_px
        self._get_or_compute = get_or_compute
        self._seed = seed

    def estimate(self, matches: Matches, history: MotionHistory) -> tuple[TwoViewEstimate, MotionHistory] | None:
        """Rotation and direction of the next motion, and the history with it; None without a consensus."""
        reliable = matches.weights >= _LEAST_PROPOSING_WEIGHT
        first, second = matches.rays_previous[reliable], matches.rays_current[reliable]
        proposed = self._by_essential(first, second)
        prior = self._prior(matches, proposed, history)
        candidates = [self._refined(matches, proposed, prior)]
        if candidates[0] is None or candidates[0].inliers.mean() < _EARLY_EXIT_INLIER_RATIO:
            by_points = self._by_pnp(first, second, matches.depth_previous[reliable])
            candidates += [self._refined(matches, other, prior) for other in (by_points, history.last)]
        found = [candidate for candidate in candidates if candidate is not None]
        if not found:
            return None
        best = max(found, key=lambda candidate: _support(candidate, prior))
        error = self._depth_relative_error(matches, best.unit_pose)
        return best, history.with_step(best.unit_pose, error)

    def refined(self, matches: Matches, start: UnitRelativePose, depth_relative_error: float) -> TwoViewEstimate | None:
        """The motion refined from a well-known ``start``.

        Learned depth has a small weight: it is needed only to choose between motions.
        """
        sigma = float(np.deg2rad(_DIRECTION_PRIOR_SIGMA_DEG))
        return self._refined(
            matches, start, MotionPrior(_PATCH_WIDENING * depth_relative_error, start.direction, sigma)
        )

    def _by_essential(self, first: FloatArray, second: FloatArray) -> UnitRelativePose | None:
        tolerance = INLIER_PX / self._focal_px
        given = first, second, repr((tolerance, self._seed))
        return self._cached_unit_pose(
            "motion by essential matrix", given, lambda: unit_pose_by_essential(first, second, tolerance, self._seed)
        )

    def _by_pnp(self, first: FloatArray, second: FloatArray, depth: FloatArray) -> UnitRelativePose | None:
        tolerance = _RESECTION_PX / self._focal_px
        given = first, second, depth, repr((tolerance, self._seed))
        return self._cached_unit_pose(
            "motion by PnP", given, lambda: unit_pose_by_pnp(first, second, depth, tolerance, self._seed)
        )

    def _cached_unit_pose(
        self, kind: str, given: tuple[Given, ...], find: Callable[[], UnitRelativePose | None]
    ) -> UnitRelativePose | None:
        def answer() -> Answer:
            found = find()
            return () if found is None else (found.R_current_previous, found.direction)

        known = self._get_or_compute(kind, given, answer)
        return UnitRelativePose(*known) if known else None

    def _prior(self, matches: Matches, proposed: UnitRelativePose | None, history: MotionHistory) -> MotionPrior:
        """The prior from the history; without one, the error of learned depth is that under the proposed motion."""
        errors = history.depth_relative_errors
        if not errors and proposed is not None:
            errors = (self._depth_relative_error(matches, proposed),)
        error = usual_error(errors, DEPTH_RELATIVE_SIGMA)
        return history.prior(error, float(np.deg2rad(_DIRECTION_PRIOR_SIGMA_DEG)))

    def _depth_relative_error(self, matches: Matches, unit_pose: UnitRelativePose) -> float:
        """Relative error of learned depth against triangulated depth of inlier corners, scale aside."""
        ratios = self._ratios(matches, unit_pose, self._residuals(matches))
        if len(ratios) < _LEAST_POINTS:
            return np.nan
        return mad_sigma(ratios - np.median(ratios))

    def _ratios(self, matches: Matches, unit_pose: UnitRelativePose, residuals: Residuals) -> FloatArray:
        """Logarithms of learned over triangulated depth, of corners near their epipolar lines with parallax."""
        distance, _ = residuals.across(unit_pose, tangent_of(unit_pose.direction))
        depth = triangulated_depth(matches.rays_previous, matches.rays_current, unit_pose)
        rotated = _image(unit_pose.R_current_previous @ matches.rays_previous.T)
        shift_px = np.hypot(*(matches.rays_current.T[:2] - rotated)) * self._focal_px
        usable = (np.abs(distance) < INLIER_PX) & (depth > 0) & (shift_px > 1.0)
        usable &= np.isfinite(matches.depth_previous)
        return np.asarray(np.log(matches.depth_previous[usable] / depth[usable]))

    def _residuals(self, matches: Matches) -> Residuals:
        return Residuals(matches.rays_previous, matches.rays_current, matches.depth_previous, self._focal_px)

    def _refined(self, matches: Matches, start: UnitRelativePose | None, prior: MotionPrior) -> TwoViewEstimate | None:
        if start is None:
            return None

        def refine() -> Answer:
            found = self._fitted(matches, start, prior)
            if found is None:
                return ()
            return found.unit_pose.R_current_previous, found.unit_pose.direction, found.covariance, found.inliers

        settings = repr(
            (
                prior.depth_relative_error,
                prior.axis_sigma,
                INLIER_PX,
                _ALONG_PX,
                self._focal_px,
            )
        )
        corners = (matches.rays_previous, matches.rays_current, matches.depth_previous, matches.weights)
        begin = (start.R_current_previous, start.direction, prior.axis)
        known = self._get_or_compute("two-view refinement", (*corners, *begin, settings), refine)
        return TwoViewEstimate(UnitRelativePose(known[0], known[1]), known[2], known[3].astype(bool)) if known else None

    def _fitted(self, matches: Matches, start: UnitRelativePose, prior: MotionPrior) -> TwoViewEstimate | None:
        """Gauss-Newton with Cauchy weights over rotation, direction and the length in the unit of learned depth.

        Across its epipolar line a corner has the noise of the image, along it that of learned depth.
        """
        residuals = self._residuals(matches)
        ratios = self._ratios(matches, start, residuals)
        if len(ratios) < _LEAST_POINTS:
            return None
        unit_pose, length = start, float(np.exp(np.median(ratios)))
        known = np.isfinite(matches.depth_previous)
        for iteration in range(_ITERATIONS):
            tangent = tangent_of(unit_pose.direction)
            across, by_motion = residuals.across(unit_pose, tangent)
            along, by_all, shift_px = residuals.along(unit_pose, length, tangent)
            near = np.abs(across) < INLIER_PX
            sigma_along = np.hypot(_ALONG_PX, prior.depth_relative_error * shift_px)
            inliers = near & (~known | (np.abs(along) < _ALONG_SIGMAS * sigma_along))
            if inliers.sum() < _LEAST_POINTS:
                return None
            sigma = max(mad_sigma(across[near]), 1e-3 * INLIER_PX)
            weights = inliers * matches.weights / (1.0 + (across / (2.0 * sigma)) ** 2)
            weights_along = known * weights / (sigma_along**2 * (1.0 + (along / (2.0 * sigma_along)) ** 2))
            weights = weights / sigma**2
            normal = (weights_along * by_all) @ by_all.T + 1e-9 * np.eye(6)
            normal[:5, :5] += (weights * by_motion) @ by_motion.T
            gradient = by_all @ (weights_along * along)
            gradient[:5] += by_motion @ (weights * across)
            deviation = unit_pose.direction - np.copysign(1.0, prior.axis @ unit_pose.direction) * prior.axis
            normal[3:5, 3:5] += np.eye(2) / prior.axis_sigma**2
            gradient[3:5] += tangent.T @ deviation / prior.axis_sigma**2
            step = -_OVERSTEP * np.linalg.solve(normal, gradient)
            if iteration == _ITERATIONS - 1 or np.abs(step[:5]).max() < _CONVERGED:
                break
            direction = unit_pose.direction + tangent @ step[3:5]
            R_current_previous = Rotation.from_rotvec(step[:3]).as_matrix() @ unit_pose.R_current_previous
            unit_pose = UnitRelativePose(R_current_previous, direction / np.linalg.norm(direction))
            length = max(length + float(step[5]), 0.2 * length)
        lift = np.zeros((6, 5))
        lift[:3, :3], lift[3:, 3:] = np.eye(3), tangent
        return TwoViewEstimate(unit_pose, lift @ np.linalg.inv(normal)[:5, :5] @ lift.T, inliers)


def _support(candidate: TwoViewEstimate, prior: MotionPrior) -> float:
    """Number of inliers, less the cost of a deviation from the usual axis, forwards or backwards."""
    cosine = abs(float(prior.axis @ candidate.unit_pose.direction))
    deviation = float(np.arccos(min(cosine, 1.0))) / prior.axis_sigma
    return float(candidate.inliers.sum()) - 0.5 * deviation**2 / _OUTLIER_COST


def _image(points: FloatArray) -> FloatArray:
    """Points ``(3, M)`` projected to the plane z = 1, ``(2, M)``."""
    return np.asarray(points[:2] / _ahead(points))


def _ahead(points: FloatArray) -> FloatArray:
    """z of points ``(3, M)``, kept positive."""
    return np.asarray(np.maximum(points[2], 1e-6))
