"""Loop closure over a whole run: candidates, verified loops, and the consistent ones among them.

Loops agree with the odometry and with each other by pairwise consistency as in PCM (Mangelson et
al. 2018), between neighbours only: two loops whose ends are near each other must close a cycle with
the two short stretches of odometry between their ends.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.processes import side_by_side
from slam.config.sections import LoopsConfig
from slam.frames import Intrinsics, RelativePose, View
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray, invert, path_distance, rotation_angle
from slam.loops.verification import OF_FRAMES, Loop, LoopThresholds, LoopVerifier, RejectedLoop
from slam.loops.vocabulary import PlaceIndex

logger = logging.getLogger(__name__)

MOST_REJECTED = 200
# least distance of the two frames of a loop along the path: in metres, and over the median depth of
# the corners
_LEAST_PATH_M = 15.0
_LEAST_PATH_OVER_DEPTH = 0.75
_LEAST_GAP_FRAMES = 30  # least distance of the two frames of a loop, frames
_TRIED_FIRST = 4  # candidates of a view of which one must be verified before the others are tried
_SAME_PLACE = 0.05  # of the least path of a loop: 0.75 m
# loops nearby that agree, by which one corrects the unit between two parts of a map as far as it will
_OVERRULING = 3
Apart = Callable[[int], NDArray[np.bool_]]
_SUPPORT_SIGMAS = 3.0  # largest difference of supporting loops, sigmas
# drift of the odometry between supporting loops over the path between them
_SUPPORT_DRIFT_RATIO = 0.1


@dataclass(frozen=True)
class LoopClosures:
    """The result for all candidates: ``verified`` loops were measured, ``accepted`` ones are consistent.

    ``not_sought`` is the reason for no search.
    """

    candidates: int = 0
    verified: int = 0
    accepted: tuple[Loop, ...] = ()
    rejected: tuple[RejectedLoop, ...] = ()
    not_sought: str | None = None

    def without(self, dropped: Sequence[RelativePose]) -> LoopClosures:
        """The same after the pose graph dropped some accepted loops."""
        ends = {edge.ends for edge in dropped}
        kept = [loop for loop in self.accepted if loop.ends not in ends]
        gone = [
            loop.refused("contradicts the pose graph")
            for loop in self.accepted
            if loop.ends in ends
        ]
        return replace(self, accepted=tuple(kept), rejected=(*gone, *self.rejected))

    def details(self) -> dict[str, Any]:
        """For ``loops.json``: every accepted loop with its measurement, and the rejected ones with most inliers."""

        def entry(loop: Loop | RejectedLoop, reason: str) -> dict[str, Any]:
            first, last = loop.ends
            found = {"inliers": loop.inliers, "score": round(loop.score, 4), "reason": reason}
            return {"from": first, "to": last} | found

        accepted = []
        for loop in self.accepted:
            pose = loop.measured
            measured = {"T_from_to": pose.T_from_to.tolist(), "sigmas": pose.sigmas.tolist()}
            accepted.append(entry(loop, f"{loop.inliers} inliers in both directions") | measured)
        return {
            "accepted": accepted,
            "rejected": [entry(loop, loop.reason) for loop in self.rejected[:MOST_REJECTED]],
            "rejected_left_out": max(len(self.rejected) - MOST_REJECTED, 0),
        }


def close_loops(
    views: Sequence[View],
    T_world_camera: FloatArray,
    intrinsics: Intrinsics,
    config: LoopsConfig,
    is_metric: bool,
    seed: int = 0,
) -> LoopClosures:
    """Find the loops of a drive, once after its last frame.

    Args:
        views: in time order, their points in the unit of the odometry.
        T_world_camera: the odometry ``(N, 4, 4)``.
        intrinsics: of all views.
        config: whether loops are sought.
        is_metric: whether the unit of the odometry is the metre.
        seed: of RANSAC.
    """
    if not config.enabled:
        return LoopClosures(not_sought="loop closure is switched off (loops.enabled)")
    track, least = Track.of_drive(T_world_camera), _least_path(views, is_metric)
    frames = _frames(views)

    def apart(row: int) -> NDArray[np.bool_]:
        is_later = frames[row] - frames >= _LEAST_GAP_FRAMES
        return is_later & (track.path[frames[row]] - track.path[frames] >= least)

    closures = find_loops(views, track, apart, LoopVerifier(OF_FRAMES, intrinsics, seed))
    return replace(
        closures, accepted=tuple(_counted_once(closures.accepted, track.path, _SAME_PLACE * least))
    )


def find_loops(
    views: Sequence[View], track: Track, apart: Apart, verifier: LoopVerifier
) -> LoopClosures:
    """Loops among the views of a track that are verified and agree with each other.

    Args:
        views: in time order, of some rows of the track, their points in the units of their maps.
        track: odometry of the drive or of the keyframes of its maps.
        apart: says which views may make a loop, see `find_candidates`.
        verifier: measures the candidates.
    """

    def verdicts(candidates: Iterable[Candidate]) -> list[Loop | RejectedLoop]:
        return side_by_side(
            lambda c: verifier.verify(views[c.earlier], views[c.later], c.score), list(candidates)
        )

    candidates = find_candidates(views, apart, verifier.thresholds)
    tried = verdicts(c for c in candidates if c.rank < _TRIED_FIRST)
    seen_again = {verdict.ends[1] for verdict in tried if isinstance(verdict, Loop)}
    tried += verdicts(
        c for c in candidates if c.rank >= _TRIED_FIRST and views[c.later].index in seen_again
    )
    verified = [verdict for verdict in tried if isinstance(verdict, Loop)]
    refused = [verdict for verdict in tried if isinstance(verdict, RejectedLoop)]
    accepted, rejected = agreeing(verified, track, verifier.thresholds)
    rejected += refused
    logger.info(
        "loops: %d candidates, %d verified, %d accepted", len(tried), len(verified), len(accepted)
    )
    return LoopClosures(len(tried), len(verified), tuple(accepted), most_inliers_first(rejected))


def most_inliers_first(loops: Iterable[RejectedLoop]) -> tuple[RejectedLoop, ...]:
    """Rejected loops in the order in which they are reported."""
    return tuple(sorted(loops, key=lambda loop: (-loop.inliers, -loop.score, loop.ends[::-1])))


def _frames(views: Sequence[View]) -> NDArray[np.intp]:
    return np.array([view.index for view in views], dtype=np.intp)


def _least_path(views: Sequence[View], is_metric: bool) -> float:
    """Least distance of the two frames of a loop along the path, in the unit of the points of the views.

    It is 15 m. Where lengths are no metres, it is three quarters of the median depth of the
    corners: a camera that has moved less still sees what it saw, whatever the unit and the frame
    rate, and on streets these are 12 to 19 m.
    """
    if is_metric:
        return _LEAST_PATH_M
    depths = np.concatenate([np.zeros(0), *(view.points[:, 2] for view in views)])
    depths = depths[np.isfinite(depths)]
    return _LEAST_PATH_OVER_DEPTH * median(depths) if len(depths) else np.inf


def _counted_once(loops: Sequence[Loop], path: FloatArray, near: float) -> list[Loop]:
    """The loops with the sigmas of one loop together wherever several join the same two places, of a car that waits.

    Two frames less than ``near`` apart along the ``path`` ``(N,)`` show the same place with the
    same errors.
    """
    ends = path[np.array([loop.ends for loop in loops], int).reshape(-1, 2)]
    alike = (np.abs(ends[:, None] - ends) < near).all(axis=2).sum(axis=1)
    widened = []
    for loop, count in zip(loops, alike, strict=True):
        sigmas = float(np.sqrt(count)) * loop.measured.sigmas
        widened.append(replace(loop, measured=replace(loop.measured, sigmas=sigmas)))
    return widened


class Candidate(NamedTuple):
    """Two similar views by their rows; ``score`` is their similarity over that of neighbouring frames.

    ``rank`` counts from the best candidate of the later view, which is 0.
    """

    earlier: int
    later: int
    score: float
    rank: int


def find_candidates(
    views: Sequence[View], apart: Apart, thresholds: LoopThresholds
) -> list[Candidate]:
    """For each view, in time order, the most similar earlier views, the best first.

    Args:
        views: in time order.
        apart: says of a view, by its row, with which views it may make a loop ``(V,)``.
        thresholds: how many candidates a view has, how similar, and how far from each other.
    """
    if len(views) < 2 or not any(map(len, views)):
        return []
    weighted = PlaceIndex(views).weights
    indices, by_word = _frames(views), weighted.T.tocsr()
    neighbour = np.asarray((weighted[1:] * weighted[:-1]).sum(axis=1)).ravel()
    expected = np.maximum(np.concatenate([neighbour[:1], neighbour]), 1e-3)
    candidates = []
    for later in range(1, len(views)):
        scores = (weighted[[later]] @ by_word).toarray()[0] / expected[later]
        scores[later:] = 0.0
        scores[~apart(later)] = 0.0
        for rank, k in enumerate(_peaks(scores, indices, thresholds)):
            candidates.append(Candidate(k, later, float(scores[k]), rank))
    return candidates


def _peaks(scores: FloatArray, indices: NDArray[np.intp], thresholds: LoopThresholds) -> list[int]:
    """The best columns, none near a better one."""
    scores = scores.copy()
    peaks: list[int] = []
    while len(peaks) < thresholds.candidates:
        best = int(np.argmax(scores))
        if scores[best] < thresholds.least_score or scores[best] <= 0:
            break
        peaks.append(best)
        scores[np.abs(indices - indices[best]) <= thresholds.candidate_spacing] = 0.0
    return peaks


@dataclass(frozen=True)
class Track:
    """Odometry ``T_world_camera`` ``(N, 4, 4)`` row by row: of the frames of a drive, or of the keyframes of its maps.

    ``path`` ``(N,)`` grows by what odometry may err on. Lengths have one unit within each of
    ``maps`` ``(N,)``.
    """

    T_world_camera: FloatArray
    path: FloatArray
    frames: NDArray[np.intp]
    maps: NDArray[np.intp]

    @classmethod
    def of_drive(cls, T_world_camera: FloatArray) -> Self:
        """Of all frames of a drive, in one unit."""
        frames, one = np.arange(len(T_world_camera)), np.zeros(len(T_world_camera), np.intp)
        return cls(T_world_camera, path_distance(T_world_camera), frames, one)

    def rows(self, loops: Sequence[Loop]) -> NDArray[np.intp]:
        """Rows of both ends of loops ``(L, 2)``."""
        return np.searchsorted(
            self.frames, np.array([loop.ends for loop in loops], np.intp).reshape(-1, 2)
        )


def agreeing(
    loops: Sequence[Loop], track: Track, thresholds: LoopThresholds
) -> tuple[list[Loop], list[RejectedLoop]]:
    """Split verified loops into consistent ones, and ones without support or in conflict with others.

    Args:
        loops: in the unit of the map of their earlier end.
        track: odometry that they should agree with.
        thresholds: of the support that a loop needs, and of the drift it may correct.
    """
    limit = f"{thresholds.max_drift_ratio:.0%}"
    too_far = f"corrects the odometry by more than {limit} of the path between its frames"
    possible, doubtful = [], []
    kept: list[Loop] = []
    refused: list[RejectedLoop] = []
    for loop, (earlier, later) in zip(loops, track.rows(loops), strict=True):
        T_earlier_later = invert(track.T_world_camera[earlier]) @ track.T_world_camera[later]
        drift = np.linalg.norm((T_earlier_later - loop.measured.T_from_to)[:3, 3])
        length = track.path[later] - track.path[earlier]
        is_far = drift > thresholds.max_drift_ratio * length
        if is_far and track.maps[earlier] == track.maps[later]:
            refused.append(loop.refused(too_far))
        else:
            possible.append(loop)
            doubtful.append(is_far)
    for loop, is_doubtful, (supporting, conflicting) in zip(
        possible, doubtful, _votes_by_maps(possible, track, thresholds), strict=True
    ):
        if conflicting > supporting:
            refused.append(
                loop.refused(
                    f"contradicted by {conflicting} of {conflicting + supporting} loops nearby"
                )
            )
        elif is_doubtful and supporting < _OVERRULING:
            refused.append(loop.refused(too_far))
        elif supporting < thresholds.min_support and loop.inliers < thresholds.alone_inliers:
            refused.append(loop.refused(f"lacks support: {supporting} loops nearby agree"))
        else:
            kept.append(loop)
    return kept, refused


def _votes_by_maps(
    loops: Sequence[Loop], track: Track, thresholds: LoopThresholds
) -> NDArray[np.intp]:
    """How many loops support and conflict with each loop ``(L, 2)``: loops between the same two maps, or within one."""
    pairs, votes = track.maps[track.rows(loops)], np.zeros((len(loops), 2), np.intp)
    for first, second in np.unique(pairs, axis=0):
        chosen = np.flatnonzero((pairs == [first, second]).all(axis=1))
        between, T_world_camera = [loops[k] for k in chosen], track.T_world_camera.copy()
        if first != second:  # steps of the later map in the unit of the earlier one
            T_world_camera[track.maps == second, :3, 3] *= np.median(
                [loop.scale for loop in between]
            )
        votes[chosen] = _votes(between, track.rows(between), T_world_camera, thresholds)
    return votes


def _votes(
    loops: Sequence[Loop],
    ends: NDArray[np.intp],
    T_world_camera: FloatArray,
    thresholds: LoopThresholds,
) -> list[tuple[int, int]]:
    """How many loops nearby support and conflict with each loop; loops of the same image count once."""
    T_from_to = np.array([loop.measured.T_from_to for loop in loops]).reshape(-1, 4, 4)
    sigmas = np.array([loop.measured.sigmas for loop in loops]).reshape(-1, 6)
    votes = []
    for k, (earlier, later) in enumerate(ends):
        distance = np.abs(ends - ends[k])
        near = np.flatnonzero(
            (distance <= thresholds.support_distance).all(axis=1) & (distance[:, 1] > 0)
        )
        T_earlier = invert(T_world_camera[earlier]) @ T_world_camera[ends[near, 0]]
        T_later = invert(T_world_camera[ends[near, 1]]) @ T_world_camera[later]
        cycle = invert(T_from_to[k]) @ T_earlier @ T_from_to[near] @ T_later
        rotation = rotation_angle(cycle[:, :3, :3])
        translation = np.linalg.norm(cycle[:, :3, 3], axis=1)
        both = np.hypot(sigmas[near], sigmas[k])
        length_earlier = np.linalg.norm(T_earlier[:, :3, 3], axis=1)
        length = length_earlier + np.linalg.norm(T_later[:, :3, 3], axis=1)
        drift = np.deg2rad(thresholds.support_drift_deg) * distance[near].sum(axis=1)
        agrees = rotation < _SUPPORT_SIGMAS * both[:, 0] + drift
        agrees &= translation < _SUPPORT_SIGMAS * both[:, 3] + _SUPPORT_DRIFT_RATIO * length
        supporting = np.unique(ends[near[agrees], 1])
        conflicting = np.unique(ends[near[~agrees], 1])
        votes.append((len(supporting), len(conflicting)))
    return votes
