"""Consistency of loops with the odometry and with each other.

Pairwise consistency as in PCM (Mangelson et al. 2018), between neighbours only: two loops whose ends are near each
other must close a cycle with the two short stretches of odometry between their ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray, invert, path_distance, rotation_angle
from slam.loops.verification import Loop, LoopThresholds, RejectedLoop

_SUPPORT_SIGMAS = 3.0  # largest difference of supporting loops, sigmas
_SUPPORT_DRIFT_RATIO = 0.1  # drift of the odometry between supporting loops over the path between them


@dataclass(frozen=True)
class Track:
    """Odometry ``T_world_camera`` ``(N, 4, 4)`` row by row: of the frames of a drive, or of the keyframes of its maps.

    ``path`` ``(N,)`` grows by what odometry may err on. Lengths have one unit within each of ``maps`` ``(N,)``, and
    maps that odometry relates have one of ``worlds`` ``(N,)``.
    """

    T_world_camera: FloatArray
    path: FloatArray
    frames: NDArray[np.intp]
    maps: NDArray[np.intp]
    worlds: NDArray[np.intp]

    @classmethod
    def of_drive(cls, T_world_camera: FloatArray) -> Self:
        """Of all frames of a drive, in one unit."""
        frames, one = np.arange(len(T_world_camera)), np.zeros(len(T_world_camera), np.intp)
        return cls(T_world_camera, path_distance(T_world_camera), frames, one, one)

    def rows(self, loops: Sequence[Loop]) -> NDArray[np.intp]:
        """Rows of both ends of loops ``(L, 2)``."""
        return np.searchsorted(self.frames, np.array([loop.ends for loop in loops], np.intp).reshape(-1, 2))


def agreeing(loops: Sequence[Loop], track: Track, thresholds: LoopThresholds) -> tuple[list[Loop], list[RejectedLoop]]:
    """Split verified loops into consistent ones, and ones without support or in conflict with others.

    They are in the unit of the map of their earlier end.
    """
    possible: list[Loop] = []
    kept: list[Loop] = []
    refused: list[RejectedLoop] = []
    for loop, (earlier, later) in zip(loops, track.rows(loops), strict=True):
        T_earlier_later = invert(track.T_world_camera[earlier]) @ track.T_world_camera[later]
        drift = np.linalg.norm((T_earlier_later - loop.measured.T_from_to)[:3, 3])
        length = track.path[later] - track.path[earlier]
        if track.worlds[earlier] == track.worlds[later] and drift > thresholds.max_drift_ratio * length:
            limit = f"{thresholds.max_drift_ratio:.0%}"
            refused.append(loop.refused(f"corrects the odometry by more than {limit} of the path between its frames"))
        else:
            possible.append(loop)
    for loop, (supporting, conflicting) in zip(possible, _votes_by_maps(possible, track, thresholds), strict=True):
        if conflicting > supporting:
            refused.append(loop.refused(f"contradicted by {conflicting} of {conflicting + supporting} loops nearby"))
        elif supporting < thresholds.min_support and loop.inliers < thresholds.alone_inliers:
            refused.append(loop.refused(f"lacks support: {supporting} loops nearby agree"))
        else:
            kept.append(loop)
    return kept, refused


def _votes_by_maps(loops: Sequence[Loop], track: Track, thresholds: LoopThresholds) -> NDArray[np.intp]:
    """How many loops support and conflict with each loop ``(L, 2)``: loops between the same two maps, or within one."""
    pairs, votes = track.maps[track.rows(loops)], np.zeros((len(loops), 2), np.intp)
    for first, second in np.unique(pairs, axis=0):
        chosen = np.flatnonzero((pairs == [first, second]).all(axis=1))
        between, T_world_camera = [loops[k] for k in chosen], track.T_world_camera.copy()
        if first != second:  # steps of the later map in the unit of the earlier one
            T_world_camera[track.maps == second, :3, 3] *= np.median([loop.scale for loop in between])
        votes[chosen] = _votes(between, track.rows(between), T_world_camera, thresholds)
    return votes


def _votes(
    loops: Sequence[Loop], ends: NDArray[np.intp], T_world_camera: FloatArray, thresholds: LoopThresholds
) -> list[tuple[int, int]]:
    """How many loops nearby support and conflict with each loop; loops of the same image count once."""
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
        both = np.hypot(sigmas[near], sigmas[k])
        length = np.linalg.norm(T_earlier[:, :3, 3], axis=1) + np.linalg.norm(T_later[:, :3, 3], axis=1)
        drift = np.deg2rad(thresholds.support_drift_deg) * distance[near].sum(axis=1)
        agrees = rotation < _SUPPORT_SIGMAS * both[:, 0] + drift
        agrees &= translation < _SUPPORT_SIGMAS * both[:, 3] + _SUPPORT_DRIFT_RATIO * length
        votes.append((len(np.unique(ends[near[agrees], 1])), len(np.unique(ends[near[~agrees], 1]))))
    return votes
