"""The motion between two views that corners, learned depth and the drive so far agree on.

Corners alone can be misled: when most of what stands out in an image is a car that turns with the camera, its corners
and the distant ones lie on the epipolar lines of a motion that neither of them made (``docs/design/0010``). Two judges
tell it from the true one. A motion says how far each corner shifts along its epipolar line, and so does learned depth;
and a vehicle moves the way it has moved.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam.config import GeometryConfig
from slam.frontend.epipolar import Heading, heading_by_essential, heading_by_points, triangulated_depth
from slam.frontend.residuals import Residuals, tangent_of
from slam.frontend.steering import Steering
from slam.memory import Answer, Given, Recall, compute_anew
from slam.records import Learner
from slam.se3 import FloatArray

_ITERATIONS = 10
# reweighting alone closes half of the distance in an iteration: a step goes further by this
_OVERSTEP = 1.4
_CONVERGED = 1e-5
_MAD_TO_SIGMA = 1.4826
_LEAST_POINTS = 8
_LEAST_PROPOSING_WEIGHT = 0.2
_REMEMBERED = 100
_LEAST_REMEMBERED = 10
_RESECTION_PX = 2.0
# along its line a corner is an inlier within this many sigmas
_ALONG_SIGMAS = 2.5
# an outlier costs as much as this half-squared residual
_OUTLIER_COST = 3.0
# learned depth errs in patches: its sigma is widened by this where it need not choose between motions
_PATCH_WIDENING = 3.0
# neighbouring corners err together: beside other evidence, sigmas of independent ones are widened by this
CORNER_CORRELATION = 2.0


@dataclass(frozen=True)
class Matches:
    """``M`` corners in two images: rays ``(M, 3)`` with z = 1 in both, learned ``depth_previous`` ``(M,)`` or NaN.

    ``weights`` ``(M,)`` in (0, 1] say how far each is to be believed.
    """

    rays_previous: FloatArray
    rays_current: FloatArray
    depth_previous: FloatArray
    weights: FloatArray


@dataclass(frozen=True)
class TwoView:
    """A ``heading`` with its noise and support.

    ``covariance`` ``(6, 6)``: rotation then direction, both in the current camera, radians.
    ``inliers`` ``(M,)`` marks the corners that fit it and their learned depth.
    """

    heading: Heading
    covariance: FloatArray
    inliers: NDArray[np.bool_]


@dataclass(frozen=True)
class _Belief:
    """What a drive has shown so far: error of learned depth as a share, axis of motion ``(3,)`` and its sigma."""

    depth_share: float
    axis: FloatArray
    axis_sigma: float


class TwoViewEstimator(Learner):
    """Estimates the motions of one drive, one after the other."""

    remembers = ("_directions", "_depth_shares", "_steering", "_last")

    def __init__(self, config: GeometryConfig, focal_px: float, recall: Recall = compute_anew) -> None:
        self._config = config
        self._focal_px = focal_px
        self._recall = recall
        self._directions: deque[FloatArray] = deque(maxlen=_REMEMBERED)
        self._depth_shares: deque[float] = deque(maxlen=_REMEMBERED)
        self._steering = Steering(float(np.deg2rad(config.steering_sigma_deg)))
        self._last: Heading | None = None

    def estimate(self, matches: Matches) -> TwoView | None:
        """Rotation and direction of the next motion; None where corners agree on none."""
        believed = matches.weights >= _LEAST_PROPOSING_WEIGHT
        first, second = matches.rays_previous[believed], matches.rays_current[believed]
        proposed = self._proposed(first, second)
        belief = self._belief(matches, proposed)
        candidates = [self._refined(matches, proposed, belief)]
        if candidates[0] is None or candidates[0].inliers.mean() < self._config.clear_share:
            by_points = self._resected(first, second, matches.depth_previous[believed])
            candidates += [self._refined(matches, other, belief) for other in (by_points, self._last)]
        found = [candidate for candidate in candidates if candidate is not None]
        if not found:
            return None
        best = max(found, key=lambda candidate: _support(candidate, belief))
        self._directions.append(best.heading.direction)
        self._depth_shares.append(self._depth_share(matches, best.heading))
        self._last, covariance = self._steering.steered(best.heading, CORNER_CORRELATION**2 * best.covariance)
        return TwoView(self._last, covariance / CORNER_CORRELATION**2, best.inliers)

    @property
    def depth_share(self) -> float:
        """By how much learned depth erred so far, as a share; at least what it is always expected to."""
        return self._usual(self._depth_shares)

    def refined(self, matches: Matches, start: Heading, depth_share: float) -> TwoView | None:
        """The motion that corners agree on near one that is well known; it is not remembered, nor what was before.

        Learned depth tells motions apart, and here there is nothing left to tell apart: it weighs little.
        """
        sigma = float(np.deg2rad(self._config.habit_sigma_deg))
        return self._refined(matches, start, _Belief(_PATCH_WIDENING * depth_share, start.direction, sigma))

    def _proposed(self, first: FloatArray, second: FloatArray) -> Heading | None:
        tolerance = self._config.inlier_px / self._focal_px
        given = first, second, repr(tolerance)
        return self._recalled("motion by consensus", given, lambda: heading_by_essential(first, second, tolerance))

    def _resected(self, first: FloatArray, second: FloatArray, depth: FloatArray) -> Heading | None:
        tolerance = _RESECTION_PX / self._focal_px
        given = first, second, depth, repr(tolerance)
        return self._recalled("motion by depth", given, lambda: heading_by_points(first, second, depth, tolerance))

    def _recalled(self, kind: str, given: tuple[Given, ...], find: Callable[[], Heading | None]) -> Heading | None:
        def answer() -> Answer:
            found = find()
            return () if found is None else (found.R_current_previous, found.direction)

        known = self._recall(kind, given, answer)
        return Heading(*known) if known else None

    def _belief(self, matches: Matches, proposed: Heading | None) -> _Belief:
        """Until the drive has shown how learned depth errs, the proposed motion tells."""
        shares = list(self._depth_shares) or ([] if proposed is None else [self._depth_share(matches, proposed)])
        share = self._usual(shares)
        if len(self._directions) < _LEAST_REMEMBERED:
            return _Belief(share, np.zeros(3), np.inf)
        directions = np.array(self._directions)
        axis = np.median(directions, axis=0)
        axis = axis / max(float(np.linalg.norm(axis)), 1e-9)
        spread = _MAD_TO_SIGMA * float(np.median(np.arccos(np.clip(directions @ axis, -1.0, 1.0))))
        return _Belief(share, axis, float(np.hypot(np.deg2rad(self._config.habit_sigma_deg), spread)))

    def _usual(self, depth_shares: Iterable[float]) -> float:
        floor = self._config.depth_sigma_share
        return max(floor, float(np.nanmedian([*depth_shares, floor])))

    def _depth_share(self, matches: Matches, heading: Heading) -> float:
        """By how much learned depth differs from that of the corners near their epipolar lines, scale aside."""
        ratios = self._ratios(matches, heading, self._residuals(matches))
        if len(ratios) < _LEAST_POINTS:
            return np.nan
        return _MAD_TO_SIGMA * float(np.median(np.abs(ratios - np.median(ratios))))

    def _ratios(self, matches: Matches, heading: Heading, residuals: Residuals) -> FloatArray:
        """Logarithms of learned over triangulated depth, of corners near their lines that shift along them."""
        distance, _ = residuals.across(heading, tangent_of(heading.direction))
        depth = triangulated_depth(matches.rays_previous, matches.rays_current, heading)
        turned = _image(heading.R_current_previous @ matches.rays_previous.T)
        shift_px = np.hypot(*(matches.rays_current.T[:2] - turned)) * self._focal_px
        usable = (np.abs(distance) < self._config.inlier_px) & (depth > 0) & (shift_px > 1.0)
        usable &= np.isfinite(matches.depth_previous)
        return np.asarray(np.log(matches.depth_previous[usable] / depth[usable]))

    def _residuals(self, matches: Matches) -> Residuals:
        return Residuals(matches.rays_previous, matches.rays_current, matches.depth_previous, self._focal_px)

    def _refined(self, matches: Matches, start: Heading | None, belief: _Belief) -> TwoView | None:
        if start is None:
            return None

        def refine() -> Answer:
            found = self._fitted(matches, start, belief)
            if found is None:
                return ()
            return found.heading.R_current_previous, found.heading.direction, found.covariance, found.inliers

        settings = repr(
            (belief.depth_share, belief.axis_sigma, self._config.inlier_px, self._config.along_px, self._focal_px)
        )
        corners = (matches.rays_previous, matches.rays_current, matches.depth_previous, matches.weights)
        begin = (start.R_current_previous, start.direction, belief.axis)
        known = self._recall("motion by all", (*corners, *begin, settings), refine)
        return TwoView(Heading(known[0], known[1]), known[2], known[3].astype(bool)) if known else None

    def _fitted(self, matches: Matches, start: Heading, belief: _Belief) -> TwoView | None:
        """Gauss-Newton with Cauchy weights over rotation, direction and the length in the unit of learned depth.

        Across its epipolar line a corner has the noise of the image, along it that of learned depth.
        """
        residuals = self._residuals(matches)
        ratios = self._ratios(matches, start, residuals)
        if len(ratios) < _LEAST_POINTS:
            return None
        heading, length = start, float(np.exp(np.median(ratios)))
        known = np.isfinite(matches.depth_previous)
        for iteration in range(_ITERATIONS):
            tangent = tangent_of(heading.direction)
            across, by_motion = residuals.across(heading, tangent)
            along, by_all, shift_px = residuals.along(heading, length, tangent)
            near = np.abs(across) < self._config.inlier_px
            sigma_along = np.hypot(self._config.along_px, belief.depth_share * shift_px)
            inliers = near & (~known | (np.abs(along) < _ALONG_SIGMAS * sigma_along))
            if inliers.sum() < _LEAST_POINTS:
                return None
            sigma = max(_MAD_TO_SIGMA * float(np.median(np.abs(across[near]))), 1e-3 * self._config.inlier_px)
            weights = inliers * matches.weights / (1.0 + (across / (2.0 * sigma)) ** 2)
            weights_along = known * weights / (sigma_along**2 * (1.0 + (along / (2.0 * sigma_along)) ** 2))
            weights = weights / sigma**2
            normal = (weights_along * by_all) @ by_all.T + 1e-9 * np.eye(6)
            normal[:5, :5] += (weights * by_motion) @ by_motion.T
            gradient = by_all @ (weights_along * along)
            gradient[:5] += by_motion @ (weights * across)
            astray = heading.direction - np.copysign(1.0, belief.axis @ heading.direction) * belief.axis
            normal[3:5, 3:5] += np.eye(2) / belief.axis_sigma**2
            gradient[3:5] += tangent.T @ astray / belief.axis_sigma**2
            step = -_OVERSTEP * np.linalg.solve(normal, gradient)
            if iteration == _ITERATIONS - 1 or np.abs(step[:5]).max() < _CONVERGED:
                break
            direction = heading.direction + tangent @ step[3:5]
            R_current_previous = Rotation.from_rotvec(step[:3]).as_matrix() @ heading.R_current_previous
            heading = Heading(R_current_previous, direction / np.linalg.norm(direction))
            length = max(length + float(step[5]), 0.2 * length)
        lift = np.zeros((6, 5))
        lift[:3, :3], lift[3:, 3:] = np.eye(3), tangent
        return TwoView(heading, lift @ np.linalg.inv(normal)[:5, :5] @ lift.T, inliers)


def _support(candidate: TwoView, belief: _Belief) -> float:
    """Inliers, less what a motion off the usual axis costs; forwards and backwards are alike."""
    cosine = abs(float(belief.axis @ candidate.heading.direction))
    astray = float(np.arccos(min(cosine, 1.0))) / belief.axis_sigma
    return float(candidate.inliers.sum()) - 0.5 * astray**2 / _OUTLIER_COST


def _image(points: FloatArray) -> FloatArray:
    """Where points ``(3, M)`` fall in the plane z = 1, ``(2, M)``."""
    return np.asarray(points[:2] / _ahead(points))


def _ahead(points: FloatArray) -> FloatArray:
    """z of points ``(3, M)``, kept off zero."""
    return np.asarray(np.maximum(points[2], 1e-6))
