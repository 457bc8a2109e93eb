"""Accuracy and completeness of a map."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from slam.se3 import FloatArray, Similarity, nearest_rotation

NEAR_CAMERA_M = 20.0
COVERED_WITHIN_M = 0.3


def pose_similarity(T_world_camera_true: FloatArray, T_world_camera: FloatArray) -> Similarity:
    """The similarity that takes a trajectory and its map to the truth, poses ``(N, 4, 4)`` both.

    The rotation is the chordal mean over all orientations, scale and translation are least
    squares on positions: positions alone do not determine the roll about a straight road, which the map depends on.
    """
    R_true, R_estimate = T_world_camera_true[:, :3, :3], T_world_camera[:, :3, :3]
    R = nearest_rotation((R_true @ np.swapaxes(R_estimate, 1, 2)).sum(axis=0))
    true, estimate = T_world_camera_true[:, :3, 3], T_world_camera[:, :3, 3] @ R.T
    centred_true, centred = true - true.mean(axis=0), estimate - estimate.mean(axis=0)
    agreement, energy = float((centred_true * centred).sum()), float((centred**2).sum())
    scale = agreement / energy if agreement > 0 else 1.0
    return Similarity(scale, R, true.mean(axis=0) - scale * estimate.mean(axis=0))


def accuracy_median_m(points_true: FloatArray, distance_to_surface: Callable[[FloatArray], FloatArray]) -> float | None:
    """Median distance of map points ``(P, 3)`` to the true surface, metres; None for an empty map."""
    if len(points_true) == 0:
        return None
    return float(np.median(distance_to_surface(points_true)))


def completeness(surface_points: FloatArray, map_points: FloatArray) -> float | None:
    """Ratio of true surface points ``(S, 3)`` that have a map point ``(P, 3)`` within 0.3 m."""
    if len(surface_points) == 0:
        return None
    if len(map_points) == 0:
        return 0.0
    distances, _ = cKDTree(map_points).query(surface_points, distance_upper_bound=COVERED_WITHIN_M)
    return float(np.isfinite(distances).mean())


def visible_surface(depth_m: FloatArray, K: FloatArray, T_world_camera: FloatArray, step: int = 4) -> FloatArray:
    """True surface points ``(S, 3)`` in the world that a camera sees within 20 m.

    Args:
        depth_m: true z-depth ``(H, W)``, 0 where there is nothing.
        K: camera matrix ``(3, 3)``.
        T_world_camera: ``(4, 4)``.
        step: every n-th pixel of both axes.
    """
    v, u = np.mgrid[0 : depth_m.shape[0] : step, 0 : depth_m.shape[1] : step]
    depth = np.asarray(depth_m[v, u], dtype=np.float64)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(depth)], axis=-1)
    points_camera = rays * depth[..., None]
    near = (depth > 0) & (np.linalg.norm(points_camera, axis=-1) < NEAR_CAMERA_M)
    points_world: FloatArray = points_camera[near] @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    return points_world
