"""Relative poses from the images themselves: rotation and direction from corners, length from learned depth.

As in DF-VO (Zhan et al. 2020): an essential matrix where the parallax carries one, its length from the
ratio of learned to triangulated depth; perspective-n-point against learned depth where it does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from slam.config import GeometryConfig
from slam.frames import DepthMap, Frame, Intrinsics, RelativePose
from slam.frontend.failure import MeasurementFailure
from slam.frontend.visual.dynamic_mask import DynamicMask
from slam.frontend.visual.epipolar import (
    TriangulatedPoints,
    UnitRelativePose,
    depth_in_current,
    parallax_px,
    rotation_between,
    triangulated_depth,
)
from slam.frontend.visual.predicted_flow import PredictedFlow
from slam.frontend.visual.relative_rotation import RelativeRotation
from slam.frontend.visual.step_noise import StepNoise
from slam.frontend.visual.tracking import CornerTracker, Tracks
from slam.frontend.visual.two_view import CORNER_CORRELATION, Matches, TwoViewEstimate, TwoViewEstimator
from slam.robust import mad_sigma, weighted_median
from slam.se3 import FloatArray, invert, make
from slam.storage.cache import GetOrCompute, without_cache
from slam.storage.serialisation import Learner

ESSENTIAL_SOURCE = "essential"
PNP_SOURCE = "pnp"
STILL_SOURCE = "still"
_MIN_RATIOS = 8
_LEARNED_RELATIVE_SIGMA = 0.1
_LEARNED_LENGTH_RELATIVE_SIGMA = 0.05
# least rotation sigma of a camera that stands still, or whose motion points alone determine
_LEAST_ROTATION_SIGMA = np.deg2rad(0.01)


@dataclass(frozen=True)
class Motion:
    """A measured ``relative_pose``, its length by learned depth, unscaled.

    Where corners alone gave rotation and direction, ``triangulated`` holds what they triangulated and
    ``direction_sigmas`` ``(3,)`` the noise of the direction in the later camera, radians; else both are None.
    """

    relative_pose: RelativePose
    triangulated: TriangulatedPoints | None = None
    direction_sigmas: FloatArray | None = None

    @property
    def own_noise(self) -> StepNoise:
        """What the corners promise of rotation and direction.

        Raises:
            ValueError: it has no direction apart from its length.
        """
        if self.direction_sigmas is None:
            raise ValueError(f"a motion by {self.relative_pose.source} has no direction apart from its length")
        return StepNoise(self.relative_pose.sigmas[:3], self.direction_sigmas)

    def with_rotation(self, R_current_previous: FloatArray) -> Motion:
        """The same way seen from the current camera, with another turn ``(3, 3)``."""
        T_current_previous = make(R_current_previous, invert(self.relative_pose.T_from_to)[:3, 3])
        return replace(self, relative_pose=replace(self.relative_pose, T_from_to=invert(T_current_previous)))

    def with_length(
        self, length: float, relative_sigma: float, relative_correlated_sigma: float, noise: StepNoise
    ) -> RelativePose:
        """The same rotation and direction with a length from elsewhere, and the noise that the drive showed there.

        Args:
            length: in the unit wanted.
            relative_sigma: its relative sigma.
            relative_correlated_sigma: of independent errors that add up along the steps as those of the lengths do.
            noise: of rotation and direction, beside the corners' own.
        """
        own = self.own_noise
        T_previous_current = self.relative_pose.T_from_to.copy()
        T_previous_current[:3, 3] *= length / np.linalg.norm(T_previous_current[:3, 3])
        rotation, direction = np.hypot(own.rotation, noise.rotation), np.hypot(own.direction, noise.direction)
        sigmas, correlated_sigmas = (
            _sigmas(T_previous_current, rotation, direction, share)
            for share in (relative_sigma, relative_correlated_sigma)
        )
        return replace(
            self.relative_pose, T_from_to=T_previous_current, sigmas=sigmas, correlated_sigmas=correlated_sigmas
        )


class VisualOdometry(Learner):
    """Measures ``T_previous_current`` between frames of one sequence, in the unscaled unit of depth."""

    remembers = ("_tracker", "_dynamic_mask", "_two_views", "_last")

    def __init__(
        self, config: GeometryConfig, intrinsics: Intrinsics, get_or_compute: GetOrCompute = without_cache
    ) -> None:
        self._config = config
        self._intrinsics = intrinsics
        self._tracker = CornerTracker(config, get_or_compute)
        self._dynamic_mask = DynamicMask(intrinsics.width, intrinsics.height, config.dynamic_mask_sharpness)
        self._two_views = TwoViewEstimator(config, intrinsics.fx, get_or_compute)
        self._last: tuple[UnitRelativePose, float] | None = None

    def measure(
        self,
        previous: Frame,
        current: Frame,
        depth_previous_unscaled: DepthMap,
        height_unscaled: float | None = None,
    ) -> Motion | MeasurementFailure:
        """Measure the motion between two frames.

        Args:
            previous: the earlier frame, at the size of the intrinsics.
            current: a later frame.
            depth_previous_unscaled: learned z-depth ``(H, W)`` of the earlier frame.
            height_unscaled: camera height in the same unit; where known, farther depths than
                ``max_depth_heights`` of it are not trusted.
        """
        adjacent = current.index == previous.index + 1
        predicted_flow = None
        if self._config.predicted_flow and adjacent and self._last is not None:
            predicted_flow = PredictedFlow(*self._last, depth_previous_unscaled, self._intrinsics)
        tracks = self._tracker.track(previous, current, predicted_flow)
        if len(tracks.previous) < self._config.min_inliers:
            return MeasurementFailure(f"only {len(tracks.previous)} corners could be followed")
        learned = _sample(depth_previous_unscaled, tracks.previous)
        depth = self._trusted(learned, height_unscaled)
        step = (previous.index, current.index)
        measured = (
            self._still(step, tracks, depth)
            or self._by_essential(step, tracks, learned, depth)
            or (self._by_points(step, tracks, depth))
        )
        if adjacent:
            self._last = (
                None
                if isinstance(measured, MeasurementFailure)
                else _unit_pose_and_length(measured.relative_pose.T_from_to)
            )
        return measured

    def relative_rotation_task(
        self, first: Frame, last: Frame, depth_first_unscaled: DepthMap, T_first_last: FloatArray
    ) -> Callable[[], RelativeRotation | None]:
        """How to measure the turn between frames some steps apart, both measured already.

        Args:
            first: the earlier frame.
            last: the later frame.
            depth_first_unscaled: learned z-depth ``(H, W)`` of the earlier frame.
            T_first_last: the motion as its steps were measured, unscaled.

        Returns:
            Measures it, in any thread, by what is known now; None where too few corners tell.
        """
        known = _unit_pose_and_length(T_first_last)
        if known is None:
            return lambda: None
        follow = self._tracker.ask_across(first, last, PredictedFlow(*known, depth_first_unscaled, self._intrinsics))
        dynamic_mask, depth_relative_error = self._dynamic_mask.as_now(), self._two_views.depth_relative_error

        def measure() -> RelativeRotation | None:
            tracks = follow()
            if len(tracks.previous) < self._config.min_inliers:
                return None
            matches = self._matches(tracks, _sample(depth_first_unscaled, tracks.previous), dynamic_mask)
            found = self._two_views.refined(matches, known[0], depth_relative_error)
            if found is None or found.inliers.sum() < self._config.min_inliers:
                return None
            sigmas = np.sqrt(np.diag(found.covariance)[:3])
            return RelativeRotation(first.index, last.index, found.unit_pose.R_current_previous, sigmas)

        return measure

    def _trusted(self, depth: FloatArray, height_unscaled: float | None) -> FloatArray:
        """Depths ``(M,)`` with NaN where not trusted."""
        farthest = np.inf if height_unscaled is None else self._config.max_depth_heights * height_unscaled
        return np.where(depth < farthest, depth, np.nan)

    def _matches(self, tracks: Tracks, learned: FloatArray, dynamic_mask: DynamicMask) -> Matches:
        weights = dynamic_mask.weights(tracks.previous)
        return Matches(self._intrinsics.rays(tracks.previous), self._intrinsics.rays(tracks.current), learned, weights)

    def _still(self, step: tuple[int, int], tracks: Tracks, depth: FloatArray) -> Motion | None:
        flow = float(np.median(np.linalg.norm(tracks.current - tracks.previous, axis=1)))
        if flow >= self._config.still_flow_px or not np.isfinite(depth).any():
            return None
        # a forward step of t moves a point at depth z and r pixels from the centre by r t / z
        typical_radius_px = 0.25 * self._intrinsics.width
        translation = max(flow, 0.1) * float(np.nanmedian(depth)) / typical_radius_px
        sigmas = np.repeat([_LEAST_ROTATION_SIGMA, translation], 3)
        return Motion(RelativePose(*step, np.eye(4), sigmas, STILL_SOURCE))

    def _by_essential(
        self, step: tuple[int, int], tracks: Tracks, learned: FloatArray, depth: FloatArray
    ) -> Motion | None:
        """Rotation and direction from the essential matrix, None where it is not well conditioned."""
        matches = self._matches(tracks, learned, self._dynamic_mask)
        rays_previous, rays_current = matches.rays_previous, matches.rays_current
        # an essential matrix of a pure rotation invents a translation: only believe one that is needed
        turned = rotation_between(rays_previous, rays_current)
        unexplained = parallax_px(rays_previous, rays_current, turned, self._intrinsics)
        if np.median(unexplained) < self._config.min_parallax_px:
            return None
        two_view = self._two_views.estimate(matches)
        if two_view is not None and step[1] == step[0] + 1:
            self._dynamic_mask.learn(tracks.current, two_view.inliers)
        if two_view is None or two_view.inliers.sum() < self._config.min_inliers:
            return None
        unit_pose = two_view.unit_pose
        parallax = parallax_px(rays_previous, rays_current, unit_pose.R_current_previous, self._intrinsics)
        depth_previous = triangulated_depth(rays_previous, rays_current, unit_pose)
        solid = two_view.inliers & (depth_previous > 0) & (parallax > self._config.min_point_parallax_px)
        measures = solid & np.isfinite(depth)
        if measures.sum() < _MIN_RATIOS:
            return None
        relative_sigma = self._config.inlier_px / np.maximum(parallax, 1e-9)
        length, spread = _length(depth[measures] / depth_previous[measures], relative_sigma[measures])
        T_previous_current = invert(make(unit_pose.R_current_previous, length * unit_pose.direction))
        rotation, direction = self._essential_sigmas(two_view)
        depth_current = depth_in_current(rays_previous, depth_previous, unit_pose)
        solid &= depth_current > 0
        triangulated = TriangulatedPoints(
            tracks.track_ids[solid], depth_previous[solid], depth_current[solid], relative_sigma[solid]
        )
        sigmas = _sigmas(T_previous_current, rotation, direction, max(spread, _LEARNED_LENGTH_RELATIVE_SIGMA))
        return Motion(RelativePose(*step, T_previous_current, sigmas, ESSENTIAL_SOURCE), triangulated, direction)

    def _essential_sigmas(self, two_view: TwoViewEstimate) -> tuple[FloatArray, FloatArray]:
        """Sigmas of rotation and direction ``(3,)`` each, in the current camera, where GTSAM perturbs."""
        own = np.sqrt(np.diag(two_view.covariance))
        rotation = np.hypot(own[:3], np.deg2rad(self._config.rotation_floor_deg))
        floor = np.deg2rad(self._config.direction_floor_deg)
        return rotation, np.hypot(own[3:], floor * np.sqrt(np.maximum(1.0 - two_view.unit_pose.direction**2, 0.0)))

    def _by_points(self, step: tuple[int, int], tracks: Tracks, depth: FloatArray) -> Motion | MeasurementFailure:
        """Perspective-n-point of the later image's corners on the earlier frame's learned depth."""
        known = np.isfinite(depth)
        if known.sum() < self._config.min_inliers:
            return MeasurementFailure(f"only {int(known.sum())} corners have a trusted depth")
        points_previous = self._intrinsics.rays(tracks.previous[known]) * depth[known, None]
        pixels = tracks.current[known]
        cv2.setRNGSeed(0)
        found, rotation, translation, chosen = cv2.solvePnPRansac(
            points_previous,
            pixels,
            self._intrinsics.K,
            None,
            iterationsCount=200,
            reprojectionError=self._config.reprojection_px,
            confidence=0.999,
        )
        count = 0 if not found or chosen is None else len(chosen)
        if count < self._config.min_inliers:
            return MeasurementFailure(f"little parallax, and only {count} corners agree with the learned depth")
        chosen = chosen.ravel()
        rotation, translation = cv2.solvePnPRefineLM(
            points_previous[chosen], pixels[chosen], self._intrinsics.K, None, rotation, translation
        )
        R_current_previous = Rotation.from_rotvec(rotation.ravel()).as_matrix()
        sigmas = self._points_sigmas(points_previous[chosen], pixels[chosen], rotation, translation)
        T_previous_current = invert(make(R_current_previous, translation.ravel()))
        return Motion(RelativePose(*step, T_previous_current, sigmas, PNP_SOURCE))

    def _points_sigmas(
        self, points: FloatArray, pixels: FloatArray, rotation: FloatArray, translation: FloatArray
    ) -> FloatArray:
        """Sigmas ``(6,)`` from the reprojection's Jacobian, widened by the learned depth's own error."""
        projected, jacobian = cv2.projectPoints(points, rotation, translation, self._intrinsics.K, None)
        residual = (projected.reshape(-1, 2) - pixels).ravel()
        sigma = max(mad_sigma(residual), 0.1)
        J = jacobian[:, :6]
        own = CORNER_CORRELATION * sigma * np.sqrt(np.diag(np.linalg.inv(J.T @ J + 1e-12 * np.eye(6))))
        length = float(np.linalg.norm(translation))
        floors = np.repeat([_LEAST_ROTATION_SIGMA, _LEARNED_RELATIVE_SIGMA * length], 3)
        return np.asarray(np.hypot(own, floors))


def _unit_pose_and_length(T_previous_current: FloatArray) -> tuple[UnitRelativePose, float] | None:
    T_current_previous = invert(T_previous_current)
    length = float(np.linalg.norm(T_current_previous[:3, 3]))
    return (
        (UnitRelativePose(T_current_previous[:3, :3], T_current_previous[:3, 3] / length), length)
        if length > 0
        else None
    )


def _sigmas(
    T_previous_current: FloatArray, rotation: FloatArray, direction: FloatArray, length_relative_sigma: float
) -> FloatArray:
    """Sigmas ``(6,)`` from those of rotation and direction ``(3,)`` and of the length, in the current camera."""
    along = np.abs(invert(T_previous_current)[:3, 3])
    length = float(np.linalg.norm(along))
    translation = np.hypot(length * direction, length_relative_sigma * along)
    return np.concatenate([rotation, np.maximum(translation, 1e-3 * length)])


def _sample(depth: DepthMap, pixels: FloatArray) -> FloatArray:
    """Depth at the nearest pixel of each point, NaN where there is none."""
    height, width = depth.shape
    u = np.clip(np.rint(pixels[:, 0]).astype(np.int64), 0, width - 1)
    v = np.clip(np.rint(pixels[:, 1]).astype(np.int64), 0, height - 1)
    sampled = depth[v, u].astype(np.float64)
    return np.where(np.isfinite(sampled) & (sampled > 0), sampled, np.nan)


def _length(ratios: FloatArray, triangulation_relative_sigma: FloatArray) -> tuple[float, float]:
    """Weighted median of learned over triangulated depth, and its relative sigma.

    A point weighs by the relative variance of both depths; the median withstands moving cars.
    """
    logarithms = np.log(ratios)
    weights = 1.0 / (_LEARNED_RELATIVE_SIGMA**2 + triangulation_relative_sigma**2)
    centre = weighted_median(logarithms, weights)
    deviation = mad_sigma(logarithms - centre)
    # learned depth errs in patches, not pixels: count one independent measurement in ten
    return float(np.exp(centre)), CORNER_CORRELATION * deviation / float(np.sqrt(max(len(ratios) / 10.0, 1.0)))
