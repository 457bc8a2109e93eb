"""Loop closure over a whole run: candidates, verified loops, and the consistent ones among them."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.processes import side_by_side
from slam.config.sections import LoopsConfig
from slam.frames import Intrinsics, RelativePose, View
from slam.geometry.se3 import FloatArray
from slam.loops.consistency import Track, agreeing
from slam.loops.retrieval import Apart, Candidate, find_candidates
from slam.loops.verification import OF_FRAMES, Loop, LoopVerifier, RejectedLoop

logger = logging.getLogger(__name__)

MOST_REJECTED = 200
# least distance of the two frames of a loop along the path: in metres, and over the median depth of the corners
_LEAST_PATH_M = 15.0
_LEAST_PATH_OVER_DEPTH = 0.75
_LEAST_GAP_FRAMES = 30  # least distance of the two frames of a loop, frames
_TRIED_FIRST = 4  # candidates of a view of which one must be verified before the others are tried
_SAME_PLACE = 0.05  # of the least path of a loop: 0.75 m


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
        ends = {(edge.from_index, edge.to_index) for edge in dropped}
        gone = tuple(loop.refused("contradicts the pose graph") for loop in self.accepted if loop.ends in ends)
        kept = tuple(loop for loop in self.accepted if loop.ends not in ends)
        return replace(self, accepted=kept, rejected=gone + self.rejected)

    def details(self) -> dict[str, Any]:
        """For ``loops.json``: every accepted loop with its measurement, and the rejected ones with most inliers."""

        def entry(ends: tuple[int, int], loop: Loop | RejectedLoop, **more: Any) -> dict[str, Any]:
            return {"from": ends[0], "to": ends[1], "inliers": loop.inliers, "score": round(loop.score, 4), **more}

        accepted = []
        for loop in self.accepted:
            reason, measured = f"{loop.inliers} inliers in both directions", loop.measured
            measurement = {"T_from_to": measured.T_from_to.tolist(), "sigmas": measured.sigmas.tolist()}
            accepted.append(entry(loop.ends, loop, reason=reason, **measurement))
        rejected = [entry((loop.from_index, loop.to_index), loop, reason=loop.reason) for loop in self.rejected]
        more = max(len(rejected) - MOST_REJECTED, 0)
        return {"accepted": accepted, "rejected": rejected[:MOST_REJECTED], "rejected_left_out": more}


def close_loops(
    views: Sequence[View],
    T_world_camera: FloatArray,
    intrinsics: Intrinsics,
    config: LoopsConfig,
    is_metric: bool,
    seed: int = 0,
) -> LoopClosures:
    """Find the loops of a drive, once after its last frame.

    The ``views`` are in time order, their points in the unit of the odometry ``T_world_camera`` ``(N, 4, 4)``, which
    ``is_metric`` or not.
    """
    if not config.enabled:
        return LoopClosures(not_sought="loop closure is switched off (loops.enabled)")
    track, least = Track.of_drive(T_world_camera), _least_path(views, is_metric)
    frames = np.array([view.index for view in views], dtype=np.intp)

    def apart(rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        is_later = frames[rows, None] - frames >= _LEAST_GAP_FRAMES
        return np.asarray(is_later & (track.path[frames][rows, None] - track.path[frames] >= least))

    closures = find_loops(views, track, apart, LoopVerifier(OF_FRAMES, intrinsics, seed))
    return replace(closures, accepted=tuple(_counted_once(closures.accepted, track.path, _SAME_PLACE * least)))


def find_loops(views: Sequence[View], track: Track, apart: Apart, verifier: LoopVerifier) -> LoopClosures:
    """Loops among the views of a track that are verified and agree with each other.

    The views are in time order, of some rows of the track, their points in the units of their maps; ``apart`` says
    which may make a loop, see `find_candidates`.
    """

    def verdicts(candidates: Iterable[Candidate]) -> list[Loop | RejectedLoop]:
        return side_by_side(lambda c: verifier.verify(views[c.earlier], views[c.later], c.score), list(candidates))

    candidates = find_candidates(views, apart, verifier.thresholds)
    tried = verdicts(c for c in candidates if c.rank < _TRIED_FIRST)
    seen_again = {verdict.ends[1] for verdict in tried if isinstance(verdict, Loop)}
    tried += verdicts(c for c in candidates if c.rank >= _TRIED_FIRST and views[c.later].index in seen_again)
    verified = [verdict for verdict in tried if isinstance(verdict, Loop)]
    accepted, rejected = agreeing(verified, track, verifier.thresholds)
    rejected += [verdict for verdict in tried if isinstance(verdict, RejectedLoop)]
    logger.info("loops: %d candidates, %d verified, %d accepted", len(tried), len(verified), len(accepted))
    return LoopClosures(len(tried), len(verified), tuple(accepted), most_inliers_first(rejected))


def most_inliers_first(loops: Iterable[RejectedLoop]) -> tuple[RejectedLoop, ...]:
    """Rejected loops in the order in which they are reported."""
    return tuple(sorted(loops, key=lambda loop: (-loop.inliers, -loop.score, loop.to_index, loop.from_index)))


def _least_path(views: Sequence[View], is_metric: bool) -> float:
    """Least distance of the two frames of a loop along the path, in the unit of the points of the views.

    It is 15 m. Where lengths are no metres, it is three quarters of the median depth of the corners: a camera that has
    moved less still sees what it saw, whatever the unit and the frame rate, and on streets these are 12 to 19 m.
    """
    if is_metric:
        return _LEAST_PATH_M
    depths = np.concatenate([np.zeros(0), *(view.points[:, 2] for view in views)])
    depths = depths[np.isfinite(depths)]
    return _LEAST_PATH_OVER_DEPTH * float(np.median(depths)) if len(depths) else np.inf


def _counted_once(loops: Sequence[Loop], path: FloatArray, near: float) -> list[Loop]:
    """The loops with the sigmas of one loop together wherever several join the same two places, of a car that waits.

    Two frames less than ``near`` apart along the ``path`` ``(N,)`` show the same place with the same errors.
    """
    ends = path[np.array([loop.ends for loop in loops], int).reshape(-1, 2)]
    alike = (np.abs(ends[:, None] - ends) < near).all(axis=2).sum(axis=1)
    return [loop.widened(float(np.sqrt(count))) for loop, count in zip(loops, alike, strict=True)]
