"""The first motion with parallax: which of a motion and its reverse fits a scene without relief.

A scene without relief fits a motion and its reverse alike, with near and far exchanged. From
learned depth alone the adjustment may end in the wrong one, and from there no later keyframe leads
back. So the first motion with parallax, where points have nothing but learned depth, also starts
from motions by essential matrix and homographies (Faugeras and Lustman 1988), and what fits best is
taken.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from slam.frames import Intrinsics
from slam.frontend.keyframes.bundle_adjustment import BundleAdjustment, Sightings
from slam.frontend.keyframes.local_map import DEPTH_SIGMA
from slam.frontend.visual.two_view import CORNER_CORRELATION
from slam.geometry.multiview import (
    triangulated_depth,
    unit_pose_by_essential,
    unit_poses_by_homography,
)
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray, make

_INLIER_PX = 1.0
# iterations of an adjustment, and the relative fall of the cost at which it ends
_LIMITS = 30, 1e-4
# of the cost: three sigmas, of corners whose errors are correlated
_GAIN = 0.5 * (3.0 * CORNER_CORRELATION) ** 2


def first_motion(
    T_now_before: FloatArray,
    pixels_before: FloatArray,
    pixels: FloatArray,
    depth: FloatArray,
    intrinsics: Intrinsics,
    seed: int = 0,
) -> tuple[FloatArray, FloatArray]:
    """``T_now_before`` of two views, and the depth in the first one ``(M,)``, in the unit of a prior.

    Args:
        T_now_before: of the first start, in the unit of the prior.
        pixels_before: corners in the first view ``(M, 2)``.
        pixels: the same corners in the second view ``(M, 2)``.
        depth: of the corners in the first view ``(M,)``, by the prior.
        intrinsics: of both views.
        seed: of RANSAC.
    """
    rays_before, rays = intrinsics.rays(pixels_before), intrinsics.rays(pixels)
    tolerance = _INLIER_PX / intrinsics.fx
    by_essential = unit_pose_by_essential(rays_before, rays, tolerance, seed)
    motions = [] if by_essential is None else [by_essential]
    starts = [(T_now_before, depth)]
    for motion in motions + unit_poses_by_homography(rays_before, rays, tolerance, seed):
        triangulated = triangulated_depth(rays_before, rays, motion)
        ahead = triangulated > 0.0
        if ahead.any():
            unit = median(depth[ahead] / triangulated[ahead])
            at = np.where(ahead, np.clip(unit * triangulated, 0.2 * depth, 5.0 * depth), depth)
            # OpenCV's are less exact
            R = Rotation.from_matrix(motion.R_current_previous).as_matrix()
            starts.append((make(R, unit * motion.direction), at))
    rows = np.arange(len(pixels))
    sightings = Sightings(
        np.repeat([0, 1], len(rows)),
        np.tile(rows, 2),
        np.concatenate([pixels_before, pixels]),
        np.concatenate([depth, np.full(len(rows), np.nan)]),
        np.full(2 * len(rows), DEPTH_SIGMA),
    )
    problem = BundleAdjustment(sightings, intrinsics, np.array([False, True]))
    solved = [
        problem.solve(np.stack([np.eye(4), T]), rays_before * z[:, None], *_LIMITS)
        for T, z in starts
    ]
    costs = np.array([adjusted.cost for adjusted in solved])
    best = solved[int(np.argmin(costs))] if costs.min() < costs[0] - _GAIN else solved[0]
    return best.T_camera_world[1], best.points[:, 2]
