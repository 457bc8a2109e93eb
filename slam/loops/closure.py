"""Loop closure over a whole run: candidates, verified loops, and the consistent ones among them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slam.config.sections import LoopsConfig
from slam.frames import Intrinsics, RelativePose, View
from slam.geometry.se3 import FloatArray, path_distance
from slam.loops.consistency import agreeing
from slam.loops.retrieval import find_candidates, least_path
from slam.loops.thresholds import LoopThresholds
from slam.loops.verification import Loop, LoopVerifier, RejectedLoop
from slam.runtime.threads import side_by_side

logger = logging.getLogger(__name__)

MOST_REJECTED = 200
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

    def summary(self) -> dict[str, Any]:
        """For ``metrics.json``: the numbers, and the reasons of the rejected loops with most inliers."""
        if self.not_sought is not None:
            names = ("candidates", "verified", "accepted")
            absent = dict.fromkeys(names) | {f"{name}_reason": self.not_sought for name in names}
            return {**absent, "rejected": []}
        return {
            "candidates": self.candidates,
            "verified": self.verified,
            "accepted": len(self.accepted),
            "rejected": [
                {"from": loop.from_index, "to": loop.to_index, "reason": loop.reason}
                for loop in self.rejected[:MOST_REJECTED]
            ],
        }

    def details(self) -> dict[str, Any]:
        """For ``loops.json``: every accepted loop and the rejected ones with most inliers, with their measurements."""
        return {
            "accepted": [
                {
                    **_entry(*loop.ends, loop.inliers, loop.score),
                    "reason": f"{loop.inliers} inliers in both directions",
                    "T_from_to": loop.measured.T_from_to.tolist(),
                    "sigmas": loop.measured.sigmas.tolist(),
                }
                for loop in self.accepted
            ],
            "rejected": [
                {
                    **_entry(loop.from_index, loop.to_index, loop.inliers, loop.score),
                    "reason": loop.reason,
                    "T_from_to": None if loop.T_from_to is None else loop.T_from_to.tolist(),
                }
                for loop in self.rejected[:MOST_REJECTED]
            ],
            "rejected_left_out": max(len(self.rejected) - MOST_REJECTED, 0),
        }


def _entry(from_index: int, to_index: int, inliers: int, score: float) -> dict[str, Any]:
    return {"from": from_index, "to": to_index, "inliers": inliers, "score": round(score, 4)}


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
        views: in time order, their points in the unit of the trajectory.
        T_world_camera: odometry ``(N, 4, 4)``.
        intrinsics: of the images that the views were taken from.
        config: thresholds.
        is_metric: whether lengths are metres.
        seed: of all RANSAC draws.
    """
    if not config.enabled:
        return LoopClosures(not_sought="loop closure is switched off (loops.enabled)")
    path = path_distance(T_world_camera)[np.array([view.index for view in views], dtype=int)]
    least = least_path(views, is_metric)
    candidates = find_candidates(views, path, least)
    thresholds = LoopThresholds.of_frames(config)
    verifier = LoopVerifier(thresholds, intrinsics, seed)
    verdicts = side_by_side(lambda c: verifier.verify(views[c.earlier], views[c.later], c.score), candidates)
    verified = [verdict for verdict in verdicts if isinstance(verdict, Loop)]
    refused = [verdict for verdict in verdicts if isinstance(verdict, RejectedLoop)]
    kept, lonely = agreeing(verified, T_world_camera, thresholds)
    accepted = _counted_once(kept, path_distance(T_world_camera), _SAME_PLACE * least)
    logger.info("loops: %d candidates, %d verified, %d accepted", len(candidates), len(verified), len(accepted))
    refused.sort(key=lambda loop: (-loop.inliers, -loop.score, loop.to_index, loop.from_index))
    return LoopClosures(len(candidates), len(verified), tuple(accepted), tuple(lonely + refused))


def _counted_once(loops: Sequence[Loop], path: FloatArray, near: float) -> list[Loop]:
    """The loops with the sigmas of one loop together wherever several join the same two places, of a car that waits.

    Args:
        loops: that are accepted.
        path: distance driven up to each frame ``(N,)``.
        near: along it, within which two frames show the same place with the same errors.
    """
    ends = path[np.array([loop.ends for loop in loops], int).reshape(-1, 2)]
    alike = (np.abs(ends[:, None] - ends) < near).all(axis=2).sum(axis=1)
    return [loop.widened(float(np.sqrt(count))) for loop, count in zip(loops, alike, strict=True)]
