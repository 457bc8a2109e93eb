"""The first points of a map from two views of a general scene or of a plane.

Corners on one plane, a floor or a wall, fit many essential matrices, and a homography has two motions that both explain
the two views (Faugeras and Lustman 1988). So motions of both kinds are proposed, and the one is taken whose points fit
the frames in between best.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.frames import Intrinsics
from slam.frontend.keyframes.camera_pose import INLIER_PX, MIN_POINTS, resect
from slam.frontend.keyframes.local_map import TrackedKeyframe
from slam.frontend.keyframes.map_segment import MapSegment, View, spread
from slam.frontend.sparse_flow import Pixels
from slam.frontend.visual.epipolar import (
    UnitRelativePose,
    depth_in_current,
    parallax_px,
    triangulated_depth,
    unit_pose_by_essential,
    unit_poses_by_homography,
)
from slam.geometry.se3 import FloatArray, make, rotation_angle

_LEAST_POINTS = 40
_LEAST_RATIO = 0.5
_INLIER_PX = 1.0
_PARALLAX_PX = 4.0
# another motion that fits nearly as well is as likely
_AMBIGUOUS = 1.2
_SAME_MOTION = np.deg2rad(3.0)
# variance of a corner, square pixels: below it fits do not differ
_LEAST_COST = 0.04


@dataclass(frozen=True)
class FirstPoints:
    """``points`` ``(M, 3)`` in the first camera, NaN where unknown, in units of their median depth."""

    T_current_first: FloatArray
    points: FloatArray

    @property
    def solid(self) -> NDArray[np.bool_]:
        """The known ones ``(M,)``."""
        return np.asarray(np.isfinite(self.points[:, 0]))


def first_points(
    rays_first: FloatArray, pixels: Pixels, between: Sequence[View], intrinsics: Intrinsics, seed: int = 0
) -> FirstPoints | None:
    """Points of two views; None where no motion has enough, or two different motions fit alike.

    Args:
        rays_first: of the corners in the first camera ``(M, 3)``, z = 1.
        pixels: of the same corners in the current one ``(M, 2)``.
        between: frames in between, each with rows of these corners and their pixels.
        intrinsics: of all images.
        seed: of RANSAC.
    """
    rays = intrinsics.rays(pixels.astype(np.float64))
    tolerance = _INLIER_PX / intrinsics.fx
    by_essential = unit_pose_by_essential(rays_first, rays, tolerance, seed)
    motions = [] if by_essential is None else [by_essential]
    motions += unit_poses_by_homography(rays_first, rays, tolerance, seed)
    views = [(np.arange(len(rays)), pixels), *between]
    ranked = sorted(
        (
            (_cost(found, views, intrinsics, seed), found, motion)
            for motion in motions
            if (found := _triangulated(rays_first, rays, motion, intrinsics)) is not None
        ),
        key=lambda each: each[0],
    )
    if not ranked:
        return None
    least, best, chosen = ranked[0]
    rivals = [cost for cost, _, motion in ranked[1:] if not _alike(motion, chosen)]
    return None if rivals and rivals[0] < _AMBIGUOUS * least else best


def _triangulated(
    rays_first: FloatArray, rays: FloatArray, motion: UnitRelativePose, intrinsics: Intrinsics
) -> FirstPoints | None:
    depth = triangulated_depth(rays_first, rays, motion)
    parallax = parallax_px(rays_first, rays, motion.R_current_previous, intrinsics)
    solid = (depth > 0) & (depth_in_current(rays_first, depth, motion) > 0) & (parallax > _PARALLAX_PX)
    if solid.sum() < _LEAST_POINTS or solid.mean() < _LEAST_RATIO:
        return None
    unit = float(np.median(depth[solid]))
    points = np.where(solid[:, None], rays_first * (depth / unit)[:, None], np.nan)
    return FirstPoints(make(motion.R_current_previous, motion.direction / unit), points)


def _cost(found: FirstPoints, views: Iterable[View], intrinsics: Intrinsics, seed: int) -> float:
    """Mean squared residual of all corners in all views, each resected; unknown points count as outliers."""
    costs = []
    for rows, pixels in views:
        known = found.solid[rows]
        if known.sum() < MIN_POINTS:
            continue
        guesses = found.T_current_first, np.eye(4)
        pose = resect(guesses, found.points[rows[known]], pixels[known].astype(np.float64), intrinsics, seed)
        outside = np.full(int((~known).sum()), INLIER_PX)
        costs.append(np.square(np.minimum(np.concatenate([pose.residual_px, outside]), INLIER_PX)).mean())
    return max(float(np.mean(costs)), _LEAST_COST) if costs else float("inf")


def _alike(one: UnitRelativePose, other: UnitRelativePose) -> bool:
    turned = rotation_angle(one.R_current_previous @ other.R_current_previous.T)
    apart = np.arccos(np.clip(one.direction @ other.direction, -1.0, 1.0))
    return bool(turned < _SAME_MOTION and apart < 4.0 * _SAME_MOTION)


def add_first_keyframes(
    segment: MapSegment, later: Sequence[TrackedKeyframe], intrinsics: Intrinsics, seed: int
) -> None:
    """Keyframes and frames between the first two keyframes of a map: more views of the first points."""
    local, first, pending = segment.map, segment.map.keyframes[0], {each.index: each for each in later}
    chosen = {frame.index for frame in spread(segment.frames[:-1])} | pending.keys()
    for frame in segment.frames[:-1]:
        known = local.known(frame.track_ids)
        if frame.index not in chosen or known.sum() < MIN_POINTS:
            continue
        points, pixels = local.points[frame.track_ids[known]], frame.pixels[known].astype(np.float64)
        T = resect((np.eye(4),), points, pixels, intrinsics, seed).T_camera_world
        if frame.index in pending:
            local.add(replace(pending[frame.index], T_camera_world=T))
            continue
        _, rows, seen = np.intersect1d(first.track_ids, frame.track_ids, assume_unique=True, return_indices=True)
        places, unknown = frame.pixels[seen].astype(np.float64), np.full(len(seen), np.nan)
        same = first.descriptors[rows]
        local.add(TrackedKeyframe(frame.index, T, frame.track_ids[seen], places, places, unknown, same, None))
