"""Loops among the keyframes of maps: corners that match, and the similarity by their points in both directions.

Keyframes have points of their own map, exact within it, whose unit drifts along the map and differs between maps.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.frames import LOOP_SOURCE, Intrinsics, RelativePose, RelativeSimilarity, View
from slam.geometry.se3 import FloatArray, apply, invert, rotation_angle
from slam.loops.consistency import agreeing
from slam.loops.retrieval import similar_views
from slam.loops.thresholds import OF_KEYFRAMES
from slam.loops.verification import Loop, LoopVerifier, RejectedLoop, Sighting, matches
from slam.runtime.threads import side_by_side

logger = logging.getLogger(__name__)

_CANDIDATES = 12
_LEAST_SCALES = 8
_SIGMAS = np.concatenate([np.full(3, np.deg2rad(0.5)), np.full(3, 0.02), [0.05]])


@dataclass(frozen=True)
class MapLoop:
    """Two keyframes by their rows, ``similarity`` between their cameras, and the corners that both see.

    ``corners`` ``(M, 2)`` are rows of the corners of the earlier and of the later keyframe.
    """

    similarity: RelativeSimilarity
    corners: NDArray[np.intp]
    inliers: int
    score: float

    @property
    def rows(self) -> tuple[int, int]:
        """Of the earlier and of the later keyframe."""
        return self.similarity.from_index, self.similarity.to_index


@dataclass(frozen=True)
class MapLoops:
    """Loops ``found`` among so many ``candidates``, of which so many were ``measured``; rejected ones by frames."""

    candidates: int = 0
    measured: int = 0
    found: tuple[MapLoop, ...] = ()
    rejected: tuple[RejectedLoop, ...] = ()


def find_map_loops(
    views: Sequence[View],
    T_map_camera: FloatArray,
    maps: NDArray[np.intp],
    apart: NDArray[np.bool_],
    intrinsics: Intrinsics,
    seed: int = 0,
) -> MapLoops:
    """Loops among keyframes, each supported by another one nearby or by very many inliers.

    Args:
        views: of keyframes in time order, their points in the unit of their map.
        T_map_camera: of the keyframes ``(V, 4, 4)``.
        maps: the map of each keyframe ``(V,)``.
        apart: ``(V, V)``, whether two keyframes may make a loop: they share no points yet.
        intrinsics: of all images.
        seed: of RANSAC.
    """
    candidates = similar_views(views, apart, _CANDIDATES)
    verifier = LoopVerifier(OF_KEYFRAMES, intrinsics, seed=seed)
    verdicts = side_by_side(lambda c: _verified(c.earlier, c.later, c.score, views, verifier), candidates)
    measured = [verdict for verdict in verdicts if isinstance(verdict, MapLoop)]
    rejected = [verdict for verdict in verdicts if isinstance(verdict, RejectedLoop)]
    found: list[MapLoop] = []
    for pair in sorted({tuple(maps[list(loop.rows)].tolist()) for loop in measured}):
        between = [loop for loop in measured if tuple(maps[list(loop.rows)].tolist()) == pair]
        kept, lonely = _supported(between, T_map_camera, maps)
        found += kept
        rejected += [replace(r, from_index=views[r.from_index].index, to_index=views[r.to_index].index) for r in lonely]
    found.sort(key=lambda loop: (loop.rows[1], loop.rows[0]))
    logger.info("loops of keyframes: %d candidates, %d measured, %d kept", len(candidates), len(measured), len(found))
    return MapLoops(len(candidates), len(measured), tuple(found), tuple(rejected))


def _supported(
    loops: Sequence[MapLoop], T_map_camera: FloatArray, maps: NDArray[np.intp]
) -> tuple[list[MapLoop], list[RejectedLoop]]:
    """Loops between two maps, or within one, that agree with others and with the poses between their ends."""
    first, second = maps[list(loops[0].rows)]
    T, thresholds = T_map_camera.copy(), OF_KEYFRAMES
    if first != second:
        T[maps == second, :3, 3] *= np.median([loop.similarity.scale for loop in loops])
        thresholds = replace(thresholds, max_drift_ratio=np.inf)
    as_poses = [
        Loop(RelativePose(*loop.rows, one.T_from_to, one.sigmas[:6], LOOP_SOURCE), loop.inliers, loop.score)
        for loop, one in ((loop, loop.similarity) for loop in loops)
    ]
    kept, lonely = agreeing(as_poses, T, thresholds)
    ends = {loop.ends for loop in kept}
    return [loop for loop in loops if loop.rows in ends], lonely


def _verified(
    earlier: int, later: int, score: float, views: Sequence[View], verifier: LoopVerifier
) -> MapLoop | RejectedLoop:
    first, second = views[earlier], views[later]

    def refused(reason: str, inliers: int = 0) -> RejectedLoop:
        return RejectedLoop(first.index, second.index, reason, score, inliers)

    rows = np.column_stack(matches(first, second, OF_KEYFRAMES))
    forward = _resected(first, second, rows, verifier)
    if isinstance(forward, str):
        return refused(forward)
    backward = _resected(second, first, rows[:, ::-1], verifier)
    if isinstance(backward, str):
        return refused(f"backwards {backward}", len(forward.rows))
    inliers = min(len(forward.rows), len(backward.rows))
    scale = _scale(first, second, forward, backward)
    if scale is None:
        return refused("few corners have points in both keyframes", inliers)
    T_first_second = invert(forward.T_image_points)
    T_again = backward.T_image_points.copy()
    T_again[:3, 3] *= scale
    difference = invert(T_first_second) @ T_again
    rotation_deg = float(np.rad2deg(rotation_angle(difference[:3, :3])))
    ratio = float(np.linalg.norm(difference[:3, 3])) / forward.depth
    if rotation_deg > OF_KEYFRAMES.agreement_deg or ratio > OF_KEYFRAMES.agreement_ratio:
        reason = f"both directions differ by {rotation_deg:.1f} degrees and {ratio:.0%} of the depth"
        return refused(reason, inliers)
    units = np.concatenate([np.ones(3), np.full(3, forward.depth), np.ones(1)])
    similarity = RelativeSimilarity(earlier, later, T_first_second, scale, _SIGMAS * units)
    corners = np.unique(np.concatenate([forward.rows, backward.rows[:, ::-1]]), axis=0)
    return MapLoop(similarity, corners, inliers, score)


@dataclass(frozen=True)
class _Resected:
    """Inliers: ``rows`` ``(M, 2)`` of corners of the keyframe with the points and of that with the pixels."""

    T_image_points: FloatArray
    depth: float
    rows: NDArray[np.intp]


def _resected(points: View, pixels: View, rows: NDArray[np.intp], verifier: LoopVerifier) -> _Resected | str:
    rows = rows[np.isfinite(points.points[rows[:, 0]]).all(axis=1)]
    found = verifier.resect(points.points[rows[:, 0]], pixels.pixels[rows[:, 1]])
    if not isinstance(found, Sighting):
        return found
    return _Resected(found.T_image_points, found.depth, rows[found.resection.inliers])


def _scale(first: View, second: View, forward: _Resected, backward: _Resected) -> float | None:
    """The unit of the second keyframe in that of the first, by the depths of points that both have."""
    both = np.array([pair for pair in forward.rows.tolist() if pair[::-1] in backward.rows.tolist()], np.intp)
    if len(both) < _LEAST_SCALES:
        return None
    seen_by_second = apply(forward.T_image_points, first.points[both[:, 0]].astype(np.float64))[:, 2]
    seen_by_first = apply(backward.T_image_points, second.points[both[:, 1]].astype(np.float64))[:, 2]
    ahead = seen_by_second / second.points[both[:, 1], 2]
    behind = first.points[both[:, 0], 2] / seen_by_first
    return float(np.exp(0.5 * (np.log(np.median(ahead)) + np.log(np.median(behind)))))
