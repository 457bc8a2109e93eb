"""Relative poses from optical flow: rotation and direction from corners, length from learned depth.

As in DF-VO (Zhan et al. 2020): an essential matrix where the parallax determines one, its length
from the ratio of learned to triangulated depth; perspective-n-point against learned depth where it
does not.

The error of learned depth and the motion prior are learned from the steps before: one wrong
step teaches them to find the next one wrong too. So the road, the steps before and a car's
acceleration vote on a step that loses a third of its inliers, or has a length that no car reaches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam.frames import (
    DepthMap,
    Ends,
    Frame,
    Intrinsics,
    RelativePose,
    nearest_depth,
    resized_depth,
    trusted_depth,
)
from slam.frontend.followed_corners import CornerRecord
from slam.frontend.tracking import CornerTracker, PredictedFlow, Tracks
from slam.frontend.visual.depth_error import DepthError
from slam.frontend.visual.history import MotionHistory
from slam.frontend.visual.motion import Motion, RelativeRotation, pose_sigmas
from slam.frontend.visual.two_view import (
    CORNER_CORRELATION,
    DEPTH_RELATIVE_SIGMA,
    INLIER_PX,
    Matches,
    TwoViewEstimate,
    estimate,
    refined,
)
from slam.geometry.multiview import (
    consensus,
    depth_in_current,
    parallax_px,
    resect,
    rotation_between,
    triangulated_depth,
    triangulated_nearness,
)
from slam.geometry.robust import MAD_TO_SIGMA, mad_sigma, median, weighted_median
from slam.geometry.se3 import BoolArray, FloatArray, IntArray, apply, invert, length_of, make
from slam.runtime.errors import Failed

MIN_INLIERS = 20  # of a measurement: each satisfies both constraints
ESSENTIAL_SOURCE = "essential"
PNP_SOURCE = "pnp"
STILL_SOURCE = "still"
_MIN_RATIOS = 8
_PNP_ITERATIONS = 200
_LEAST_PNP_SHARE = 0.5  # of the corners: what fewer agree on is chance
_NEARLY_ALL = 0.9  # of the corners fit: new ones among them have a vote on the next step
_LEAST_SUPPORT = 0.25  # of those that were sought: where kerbs repeat, the others are far ahead
_LEARNED_RELATIVE_SIGMA = 0.1
_LEARNED_LENGTH_RELATIVE_SIGMA = 0.05
# least rotation sigma of a standing camera and of PnP
_LEAST_ROTATION_SIGMA = np.deg2rad(0.01)
_REPROJECTION_PX = 2.0  # largest reprojection error of a PnP inlier, pixels
# largest deviation of a corner on the road from the camera's height, in camera heights
_ROAD_TOLERANCE = 0.2
_STILL_FLOW_PX = 0.3  # median optical flow below which the camera stands still, pixels
# of a ray below the axis; the ground there is within 20 camera heights, and the sky above as far
_NEAR_SLOPE = 0.05
_LEAST_SHARED = 0.25  # of the near corners: what votes on them without those that passed by
_MOST_STILL_FLOW_PX = 1.0  # of a corner of the world before a camera that stands still, pixels
# least median optical flow that remains after rotation is removed, pixels: from the frame before, and
# from an earlier one, for which there is time until a sideways motion is told from a turn
_LEAST_PARALLAX_PX = 0.8, 1.5
_MIN_POINT_PARALLAX_PX = 2.0  # least parallax of a point used for step lengths, pixels
_ROTATION_FLOOR_DEG = 0.002  # least rotation sigma, degrees
# corners are measured in images of a megapixel at most: larger ones are no sharper, their pixels
# have more noise and less contrast, corners crowd on few objects, and the time grows with them
_MOST_PIXELS = 1e6
_DIRECTION_FLOOR_DEG = 0.045  # least sigma of the translation direction, degrees
# largest log of a length over the same by the road or by triangulated points
_AGREEMENT = 0.25
_LEAST_ROAD_CORNERS = 8
_LEAST_COMMON = 12  # points by which two steps compare their lengths


class VisualOdometry:
    """Measures ``T_previous_current`` between frames of one sequence, in the unscaled unit of depth.

    ``depth_error`` is that of learned depth by the steps so far, ``corners`` are those of their
    keyframes, in half widths from the principal point; ``below_is_nearer`` says of each whether
    corners below the axis are nearer than those above. ``found`` is the share of corners that the
    last measurement found again.
    """

    def __init__(self, intrinsics: Intrinsics, seed: int = 0) -> None:
        """Prepare for the first frames; ``seed`` is that of RANSAC."""
        ratio = float(np.sqrt(_MOST_PIXELS / (intrinsics.width * intrinsics.height)))
        if ratio < 1.0:
            intrinsics = intrinsics.resized(
                round(ratio * intrinsics.width), round(ratio * intrinsics.height)
            )
        self._intrinsics, self._size = intrinsics, (intrinsics.width, intrinsics.height)
        self._focal = intrinsics.fx, intrinsics.fy
        self._seed = seed
        self._tracker = CornerTracker()
        self.depth_error, self.corners = DepthError(), CornerRecord()
        self.below_is_nearer: list[bool] = []
        self._history = MotionHistory()
        self.found = 1.0
        self._height: float | None = None  # the last one that was known
        self._last: Motion | None = None  # to the last frame, where one was measured
        # by the last motion that corners alone gave, and the frame where it ended
        self._points: tuple[int, TriangulatedPoints | None] = (-1, None)
        # tracks that fitted the last motion have the vote on the next one: what passes between the
        # camera and the world never did, however many corners it has
        self._fitted: IntArray = np.zeros(0, np.int64)

    def measure(
        self,
        previous: Frame,
        current: Frame,
        depth_previous_unscaled: DepthMap,
        height_unscaled: float | None = None,
    ) -> Motion | Failed:
        """Measure the motion between two frames, the next two of the sequence or with others left out between them.

        Args:
            previous: the earlier frame, at the size of the intrinsics.
            current: a later frame; measured again from an earlier one where both hardly differ.
            depth_previous_unscaled: learned z-depth ``(H, W)`` of the earlier frame.
            height_unscaled: camera height in the same unit; where known, depths of more than
                30 times as much are not trusted.
        """
        previous, current = previous.resized(*self._size), current.resized(*self._size)
        depth_previous_unscaled = resized_depth(depth_previous_unscaled, *self._size)
        last, flow = self._last, None
        # by the constant-velocity model, if the last motion ended at the earlier frame and spans as
        # many frames
        if last is not None and last.ends == (2 * previous.index - current.index, previous.index):
            flow = PredictedFlow.of(
                last.relative_pose.T_from_to, depth_previous_unscaled, self._intrinsics
            )
        tracks = self._tracker.track(previous, current, flow)
        self.found = len(tracks) / max(tracks.sought, 1)
        if len(tracks) < MIN_INLIERS:
            measured: Motion | Failed = Failed(f"only {len(tracks)} corners could be tracked")
        else:
            learned = nearest_depth(depth_previous_unscaled, tracks.previous)
            depth = trusted_depth(learned, height_unscaled)
            ends, votes = (previous.index, current.index), np.isin(tracks.track_ids, self._fitted)
            if votes.sum() < MIN_INLIERS:  # few are left that fitted the last motion
                votes[:] = True
            seconds = current.stamp - previous.stamp
            measured = (
                self._still(ends, seconds, tracks, votes, depth)
                or self._by_essential(ends, seconds, tracks, votes, learned, height_unscaled)
                or self._by_points(ends, tracks, votes, depth)
            )
        self._last = measured if isinstance(measured, Motion) else None
        return measured

    def carried(self, depth_previous_unscaled: DepthMap, motion: Motion) -> DepthMap | None:
        """Depth ``(h, w)`` at the later frame of a motion from that ``(H, W)`` at the earlier one, NaN where unknown.

        None where nothing moved.
        """
        depth = resized_depth(depth_previous_unscaled, *self._size)
        flow = PredictedFlow.of(motion.relative_pose.T_from_to, depth, self._intrinsics)
        return None if flow is None else flow.depth_current()

    def relative_rotation(
        self, first: Frame, last: Frame, depth_first_unscaled: DepthMap, T_first_last: FloatArray
    ) -> Callable[[], RelativeRotation | None]:
        """Prepare to measure the rotation between two frames some steps apart, whose motion is about ``T_first_last``.

        Returns:
            A function that measures it from the present state, in any thread; its result is None
            with too few corners.
        """
        first, last = first.resized(*self._size), last.resized(*self._size)
        depth_first_unscaled = resized_depth(depth_first_unscaled, *self._size)
        flow = PredictedFlow.of(T_first_last, depth_first_unscaled, self._intrinsics)
        if flow is None:
            return lambda: None
        find = self._tracker.track_across(first, last, flow)
        error = self.depth_error

        def measure() -> RelativeRotation | None:
            tracks = find()
            if len(tracks) < MIN_INLIERS:
                return None
            votes, learned = (
                np.ones(len(tracks), dtype=bool),
                nearest_depth(depth_first_unscaled, tracks.previous),
            )
            matches = self._matches(tracks, votes, learned, None, error)
            two_view = refined(matches, flow.unit_pose)
            if two_view is None or two_view.inliers.sum() < MIN_INLIERS:
                return None
            sigmas = np.sqrt(np.diag(two_view.covariance)[:3])
            return RelativeRotation(two_view.unit_pose.R_current_previous, sigmas)

        return measure

    def _matches(
        self,
        tracks: Tracks,
        votes: BoolArray,
        learned: FloatArray,
        height: float | None,
        error: DepthError,
    ) -> Matches:
        rays_previous, rays_current = (
            self._intrinsics.rays(tracks.previous),
            self._intrinsics.rays(tracks.current),
        )
        depth, sigma = (
            error.corrected(learned),
            np.maximum(error.sigma(learned), DEPTH_RELATIVE_SIGMA),
        )
        on_road = np.zeros(len(tracks), dtype=bool)
        if height is not None:
            on_road = np.abs(rays_previous[:, 1] * depth / height - 1.0) < _ROAD_TOLERANCE
        focal_px = self._intrinsics.fx
        return Matches(rays_previous, rays_current, depth, sigma, on_road, votes, focal_px)

    def _still(
        self, ends: Ends, seconds: float, tracks: Tracks, votes: BoolArray, depth: FloatArray
    ) -> Motion | None:
        """No motion, None where near corners move: hills and gantries far ahead stand at any speed.

        Near are corners below the axis, for the ground bounds their distance.
        """
        flows = np.linalg.norm(tracks.current - tracks.previous, axis=1)
        near = self._intrinsics.rays(tracks.previous)[:, 1] > _NEAR_SLOPE
        if near.sum() >= MIN_INLIERS:
            is_shared = (votes & near).sum() >= max(MIN_INLIERS, _LEAST_SHARED * near.sum())
            votes = votes & near if is_shared else near
        flow = median(flows[votes])
        has_stopped = self._history.is_possible_speed(0.0, seconds) is not False
        if flow >= _STILL_FLOW_PX or not (has_stopped and np.isfinite(depth).any()):
            return None
        self._fitted = tracks.track_ids[flows < _MOST_STILL_FLOW_PX]
        # a forward step of t moves a point at depth z and r pixels from the centre by r t / z
        typical_radius_px = 0.25 * self._intrinsics.width
        translation = max(flow, 0.1) * float(np.nanmedian(depth)) / typical_radius_px
        sigmas = np.repeat([_LEAST_ROTATION_SIGMA, translation], 3)
        return Motion(
            RelativePose(*ends, np.eye(4), sigmas, STILL_SOURCE),
            support=len(tracks) / tracks.sought,
        )

    def _by_essential(
        self,
        ends: Ends,
        seconds: float,
        tracks: Tracks,
        votes: BoolArray,
        learned: FloatArray,
        height: float | None,
    ) -> Motion | Failed | None:
        """Rotation and direction from the essential matrix, None where it is not well conditioned."""
        matches = self._matches(tracks, votes, learned, height, self.depth_error)
        rays_previous, rays_current = matches.rays_previous[votes], matches.rays_current[votes]
        # the translation of an essential matrix is arbitrary under pure rotation: only used with
        # enough parallax
        R_current_previous = rotation_between(rays_previous, rays_current)
        unexplained = parallax_px(rays_previous, rays_current, R_current_previous, self._focal)
        if np.median(unexplained) < _LEAST_PARALLAX_PX[ends[1] > ends[0] + 1]:
            return None
        two_view = estimate(matches, self._history, self._seed)
        if two_view is None or two_view.inliers.sum() < MIN_INLIERS:
            return None
        depth = trusted_depth(learned, height)
        step = self._triangulated(ends, seconds, tracks, matches, depth, two_view)
        if step is None:
            return None
        if not is_credible(step, matches, height, self._history):
            return Failed("the step contradicts the road and the steps before")
        self._height = height or self._height
        self._learn(tracks, matches, learned, step)
        return step.motion

    def _learn(self, tracks: Tracks, matches: Matches, learned: FloatArray, step: Step) -> None:
        """Learn from a trusted step how the camera moves, and the error of learned depth."""
        two_view = step.two_view
        still = two_view.inliers
        rays = matches.rays_previous[still], matches.rays_current[still]
        nearness, per_ray = triangulated_nearness(*rays, two_view.unit_pose)
        above, below = (nearness[side * rays[0][:, 1] > _NEAR_SLOPE] for side in (-1, 1))
        if min(len(above), len(below)) >= _MIN_RATIOS:
            self.below_is_nearer.append(bool(np.median(below) > np.median(above)))
        sigma = two_view.noise_px / self._intrinsics.fx * per_ray
        speed = step.speed(self._height)
        self._history = self._history.with_step(two_view.unit_pose, step.inlier_ratio, speed)
        length = step.motion.length_unscaled
        self.depth_error = self.depth_error.with_step(learned[still], nearness, sigma, length)
        image = rays[1][:, :2] * self._intrinsics.focal_half_widths
        self._fitted = tracks.track_ids[still]
        if self.corners.is_far(self._fitted, image):
            self.corners.keep(self._fitted, image)
        self._points = step.motion.ends[1], step.points

    def _triangulated(
        self,
        ends: Ends,
        seconds: float,
        tracks: Tracks,
        matches: Matches,
        depth: FloatArray,
        two_view: TwoViewEstimate,
    ) -> Step | None:
        """The step with its length by learned depth, None with too few points for that."""
        rays_previous, rays_current = matches.rays_previous, matches.rays_current
        unit_pose = two_view.unit_pose
        parallax = parallax_px(
            rays_previous, rays_current, unit_pose.R_current_previous, self._focal
        )
        depth_previous = triangulated_depth(rays_previous, rays_current, unit_pose)
        solid = two_view.inliers & (depth_previous > 0) & (parallax > _MIN_POINT_PARALLAX_PX)
        measures = solid & np.isfinite(depth)
        if measures.sum() < _MIN_RATIOS:
            return None
        relative_sigma = INLIER_PX / np.maximum(parallax, 1e-9)
        length, spread = self.depth_error.length(
            depth[measures], depth_previous[measures], relative_sigma[measures]
        )
        # errors of learned depth are correlated in patches: one in ten counts as independent
        spread *= (
            MAD_TO_SIGMA * CORNER_CORRELATION / float(np.sqrt(max(measures.sum() / 10.0, 1.0)))
        )
        T_previous_current = invert(
            make(unit_pose.R_current_previous, length * unit_pose.direction)
        )
        across = np.maximum(1.0 - unit_pose.direction**2, 0.0)
        floors = np.concatenate(
            [np.full(3, _ROTATION_FLOOR_DEG), _DIRECTION_FLOOR_DEG * np.sqrt(across)]
        )
        covariance = two_view.covariance + np.diag(np.deg2rad(floors) ** 2)
        depth_current = depth_in_current(rays_previous, depth_previous, unit_pose)
        solid &= depth_current > 0
        triangulated = TriangulatedPoints(
            tracks.track_ids[solid],
            depth_previous[solid],
            depth_current[solid],
            relative_sigma[solid],
        )
        end, earlier = self._points
        ratio = triangulated.length_ratio(earlier) if earlier and end == ends[0] else None
        relative = max(spread, _LEARNED_LENGTH_RELATIVE_SIGMA)
        sigmas = pose_sigmas(T_previous_current, np.sqrt(np.diag(covariance)), relative)
        pose = RelativePose(*ends, T_previous_current, sigmas, ESSENTIAL_SOURCE)
        motion = Motion(
            pose, covariance, ratio, seconds, float(two_view.inliers.sum()) / tracks.sought
        )
        return Step(motion, two_view, triangulated)

    def _by_points(
        self, ends: Ends, tracks: Tracks, votes: BoolArray, depth: FloatArray
    ) -> Motion | Failed:
        """Perspective-n-point of the later image's corners on the earlier frame's learned depth."""
        known = np.isfinite(depth)
        voters = np.flatnonzero(votes[known])
        if len(voters) < MIN_INLIERS:
            return Failed(f"only {len(voters)} corners have a trusted depth")
        corrected = self.depth_error.corrected(depth[known])
        points_previous = self._intrinsics.rays(tracks.previous[known]) * corrected[:, None]
        pixels, K = tracks.current[known], self._intrinsics.K
        T_start, agreeing = consensus(
            points_previous[voters],
            pixels[voters],
            K,
            _PNP_ITERATIONS,
            _REPROJECTION_PX,
            self._seed,
        )
        trusted = voters[agreeing]
        if len(trusted) < max(MIN_INLIERS, _LEAST_PNP_SHARE * len(voters)):
            known_corners = f"{len(trusted)} of {len(voters)} corners"
            return Failed(f"little parallax, and only {known_corners} agree with the learned depth")
        resection = resect([T_start], points_previous[trusted], pixels[trusted], K)
        points_current = apply(resection.T_camera_world, points_previous)
        errors = self._intrinsics.project(points_current) - pixels
        fits = np.linalg.norm(errors, axis=1) < _REPROJECTION_PX
        if fits.mean() < _NEARLY_ALL:  # no new corner is given a vote: something passes, or repeats
            fits = np.isin(np.arange(len(fits)), trusted)
        support = float(fits.sum() / tracks.sought)
        if support < _LEAST_SUPPORT:
            return Failed(f"little parallax, and only {fits.sum()} of {tracks.sought} corners fit")
        self._fitted = tracks.track_ids[known][fits]
        length = length_of(resection.T_camera_world[:3, 3])
        # errors of corners are correlated, and so are those of learned depth
        floors = np.repeat([_LEAST_ROTATION_SIGMA, _LEARNED_RELATIVE_SIGMA * length], 3)
        sigmas = np.hypot(CORNER_CORRELATION * resection.sigmas, floors)
        pose = RelativePose(*ends, invert(resection.T_camera_world), sigmas, PNP_SOURCE)
        return Motion(pose, support=support)


@dataclass(frozen=True)
class TriangulatedPoints:
    """``M`` scene points that a step triangulated, by the identifiers of their tracks ``track_ids`` ``(M,)``.

    z-depths ``(M,)`` in both cameras are in units of the step's length, ``relative_sigma`` ``(M,)``
    is that of both.
    """

    track_ids: IntArray
    depth_previous: FloatArray
    depth_current: FloatArray
    relative_sigma: FloatArray

    def length_ratio(self, earlier: TriangulatedPoints) -> tuple[float, float] | None:
        """Log of this step's length over that of an earlier one that ends where this begins, with its sigma.

        In the frame between, a point's depth is ``|t| z`` by either step; None with too few common
        points.
        """
        _, first, second = np.intersect1d(
            earlier.track_ids, self.track_ids, assume_unique=True, return_indices=True
        )
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

    def speed(self, height_unscaled: float | None) -> float:
        """Camera heights a second, NaN where the height is unknown."""
        if height_unscaled is None or self.motion.seconds <= 0:
            return np.nan
        return self.motion.length_unscaled / height_unscaled / self.motion.seconds


def is_credible(
    step: Step, matches: Matches, height_unscaled: float | None, history: MotionHistory
) -> bool:
    """Whether a step has the speed and the inliers of those before, or as many votes for it as against it.

    Args:
        step: an estimate.
        matches: corners in both images.
        height_unscaled: of the camera above the road, in the unit of learned depth; None if
            unknown.
        history: of the steps before.
    """
    speed = step.speed(height_unscaled)
    is_possible = history.is_possible_speed(speed, step.motion.seconds)
    if is_possible is not False and not history.is_sudden_loss(step.inlier_ratio):
        return True
    votes = [] if is_possible is None else [is_possible]
    # points of this step and the one before have the ratio of lengths that learned depth has
    if (
        step.motion.length_ratio is not None
        and history.speeds
        and np.isfinite(speed / history.speeds[-1])
    ):
        ratio, _ = step.motion.length_ratio
        votes.append(bool(abs(np.log(speed / history.speeds[-1]) - ratio) < _AGREEMENT))
    # the corners on the road are triangulated at the camera's height below it
    road = matches.on_road & step.two_view.inliers
    if height_unscaled is not None and road.sum() >= _LEAST_ROAD_CORNERS:
        rays = matches.rays_previous[road]
        depth = triangulated_depth(rays, matches.rays_current[road], step.two_view.unit_pose)
        height = median(depth * rays[:, 1]) * step.motion.length_unscaled
        votes.append(bool(abs(np.log(max(height, 1e-9) / height_unscaled)) < _AGREEMENT))
    # the direction is about the median of the last hundred steps, which a few wrong ones do not
    # change
    prior = history.prior()
    if np.isfinite(prior.axis_sigma):
        votes.append(prior.deviation(step.two_view.unit_pose.direction) < 3.0)
    return 2 * sum(votes) >= len(votes)
