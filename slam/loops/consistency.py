"""Consistency of loops with the odometry and with each other.

Pairwise consistency as in PCM (Mangelson et al. 2018), between neighbours only: two loops whose ends are near each
other must close a cycle with the two short stretches of odometry between their ends.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.geometry.se3 import FloatArray, invert, path_distance, rotation_angle
from slam.loops.thresholds import LoopThresholds
from slam.loops.verification import Loop, RejectedLoop

_SUPPORT_SIGMAS = 3.0  # largest difference of supporting loops, sigmas
_SUPPORT_DRIFT_RATIO = 0.1  # drift of the odometry between supporting loops over the path between them


def agreeing(
    loops: Sequence[Loop], T_world_camera: FloatArray, thresholds: LoopThresholds
) -> tuple[list[Loop], list[RejectedLoop]]:
    """Split verified loops into consistent ones, and ones without support or in conflict with others.

    Args:
        loops: verified, in the unit of the trajectory.
        T_world_camera: odometry ``(N, 4, 4)``.
        thresholds: of nearness and of agreement.
    """
    path = path_distance(T_world_camera)
    possible, kept, refused = [], [], []
    for loop in loops:
        earlier, later = loop.ends
        T_earlier_later = invert(T_world_camera[earlier]) @ T_world_camera[later]
        drift = np.linalg.norm((T_earlier_later - loop.measured.T_from_to)[:3, 3])
        length = path[later] - path[earlier]
        if drift > thresholds.max_drift_ratio * length:
            limit = f"{thresholds.max_drift_ratio:.0%}"
            refused.append(loop.refused(f"corrects the odometry by more than {limit} of the path between its frames"))
        else:
            possible.append(loop)
    for loop, (supporting, conflicting) in zip(possible, _votes(possible, T_world_camera, thresholds), strict=True):
        if conflicting > supporting:
            refused.append(loop.refused(f"contradicted by {conflicting} of {conflicting + supporting} loops nearby"))
        elif supporting < thresholds.min_support and loop.inliers < thresholds.alone_inliers:
            refused.append(loop.refused(f"lacks support: {supporting} loops nearby agree"))
        else:
            kept.append(loop)
    return kept, refused


def _votes(loops: Sequence[Loop], T_world_camera: FloatArray, thresholds: LoopThresholds) -> list[tuple[int, int]]:
    """How many loops nearby support and conflict with each loop; loops of the same image count once."""
    ends = np.array([loop.ends for loop in loops]).reshape(-1, 2)
    T_from_to = np.array([loop.measured.T_from_to for loop in loops]).reshape(-1, 4, 4)
    sigmas = np.array([loop.measured.sigmas for loop in loops]).reshape(-1, 6)
    votes = []
    for k, (earlier, later) in enumerate(ends):
        distance = np.abs(ends - ends[k])
        near = np.flatnonzero((distance <= thresholds.support_distance).all(axis=1) & (distance[:, 1] > 0))
        T_earlier = invert(T_world_camera[earlier]) @ T_world_camera[ends[near, 0]]
        T_later = invert(T_world_camera[ends[near, 1]]) @ T_world_camera[later]
        cycle = invert(T_from_to[k]) @ T_earlier @ T_from_to[near] @ T_later
        rotation = rotation_angle(cycle[:, :3, :3])
        translation = np.linalg.norm(cycle[:, :3, 3], axis=1)
        own = np.hypot(sigmas[near], sigmas[k])
        length = np.linalg.norm(T_earlier[:, :3, 3], axis=1) + np.linalg.norm(T_later[:, :3, 3], axis=1)
        drift = np.deg2rad(thresholds.support_drift_deg) * distance[near].sum(axis=1)
        agrees = rotation < _SUPPORT_SIGMAS * own[:, 0] + drift
        agrees &= translation < _SUPPORT_SIGMAS * own[:, 3] + _SUPPORT_DRIFT_RATIO * length
        votes.append((len(np.unique(ends[near[agrees], 1])), len(np.unique(ends[near[~agrees], 1]))))
    return votes
