"""Verification of loops by perspective-n-point.

A candidate is verified on the points of two views, in both directions. All thresholds are
independent of scale: pixels, ratios, degrees, and lengths over the depth of the points.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam.frames import LOOP_SOURCE, Ends, Intrinsics, RelativePose, View
from slam.geometry.multiview import consensus, resect
from slam.geometry.robust import median
from slam.geometry.se3 import (
    FloatArray,
    apply,
    interpolate,
    invert,
    length_of,
    rotation_angle,
    tangent,
)
from slam.loops.features import hamming

_RATIO = 0.85  # largest ratio of nearest to second nearest descriptor distance
_RANSAC_ITERATIONS = 200  # RANSAC iterations of PnP
_CORNER_SIGMA_WIDENING = 1.25  # factor on the sigmas by corners
_LENGTH_RELATIVE_SIGMA = 0.04  # translation sigma over the translation
_MIN_SPREAD_RATIO = 0.1  # least standard deviation of the inliers' columns over the image width
_LEAST_SCALES = 8  # corners with points in both views, which give the ratio of their units


@dataclass(frozen=True)
class LoopThresholds:
    """Independent of scale: pixels, ratios, degrees. Distances and drift of support are by frames or by keyframes."""

    min_inliers: int = 20  # in each direction
    agreement_deg: float = 2.0  # of the rotations measured in both directions
    agreement_ratio: float = 0.1  # of the translations, over the depth
    min_support: int = 2  # images with loops nearby that agree
    candidates: int = 2  # places verified for a view
    candidate_spacing: int = 10  # between these, frames
    least_score: float = 0.2  # similarity of a candidate, over that of neighbouring views
    max_hamming: int = 64  # bits between matching descriptors
    reprojection_px: float = 3.0  # of an inlier
    min_inlier_ratio: float = 0.4  # among the matches with depth
    max_drift_ratio: float = 0.3  # correction over the path between both ends
    support_distance: int = 20  # of both ends, within which loops must agree
    support_drift_deg: float = (
        0.1  # rotation drift of the odometry between supporting loops, per frame or keyframe
    )
    alone_inliers: int = 120  # from which on a loop needs no support
    rotation_floor_deg: float = 0.02  # of the sigmas
    translation_floor_ratio: float = 0.0003  # of the sigmas, over the depth
    has_units: bool = False  # the points of both views may have different units


OF_FRAMES = LoopThresholds()
# keyframes' points are exact within a map that drifts, their descriptors further apart in distance
# and roll
OF_KEYFRAMES = LoopThresholds(
    min_inliers=15,
    agreement_deg=4.0,
    agreement_ratio=0.15,
    min_support=1,
    candidates=12,
    candidate_spacing=0,
    least_score=0.0,
    max_hamming=100,
    reprojection_px=4.0,
    min_inlier_ratio=0.3,
    support_distance=4,
    support_drift_deg=0.5,
    alone_inliers=40,
    rotation_floor_deg=0.5,
    translation_floor_ratio=0.02,
    has_units=True,
)


@dataclass(frozen=True, eq=False)
class Loop:
    """A verified loop; ``inliers`` is the smaller of both directions.

    ``measured`` is in the unit of the earlier view, ``scale`` that of the later one in it.
    ``corners`` ``(M, 2)`` are rows of corners of the earlier and of the later view that show one
    point, ``pixels`` ``(M, 2, 2)`` where they are.
    """

    measured: RelativePose
    inliers: int
    score: float
    scale: float = 1.0
    corners: NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 2), np.intp))
    pixels: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2, 2), np.float32))

    @property
    def ends(self) -> Ends:
        """Earlier and later frame."""
        return self.measured.ends

    def refused(self, reason: str) -> RejectedLoop:
        """The same loop, rejected for a reason."""
        return RejectedLoop(self.ends, reason, self.score, self.inliers)


@dataclass(frozen=True)
class RejectedLoop:
    """A rejected candidate or loop between an earlier and a later frame."""

    ends: Ends
    reason: str
    score: float
    inliers: int = 0


class Sighting(NamedTuple):
    """Points seen by a camera: ``T_camera_points``, its ``sigmas`` ``(6,)``, rows of the ``inliers``.

    ``depth`` is their median z-depth in the camera that measured them.
    """

    T_camera_points: FloatArray
    sigmas: FloatArray
    inliers: NDArray[np.intp]
    depth: float


class LoopVerifier:
    """Measures ``T_earlier_later`` between two views of one camera, in the unit of the points of the earlier one."""

    def __init__(self, thresholds: LoopThresholds, intrinsics: Intrinsics, seed: int = 0) -> None:
        self.thresholds = thresholds
        self._intrinsics = intrinsics
        self._seed = seed

    def verify(self, earlier: View, later: View, score: float) -> Loop | RejectedLoop:
        """Measure the pose of the later view in the earlier one, or reject it with a reason.

        Args:
            earlier: the earlier view, its points in its own camera, NaN where unknown.
            later: the later view, likewise.
            score: similarity of both, which is kept with the verdict.
        """
        rows_earlier, rows_later = matches(earlier, later, self.thresholds)

        def refused(reason: str, inliers: int = 0) -> RejectedLoop:
            return RejectedLoop((earlier.index, later.index), reason, score, inliers)

        if len(rows_earlier) < self.thresholds.min_inliers:
            return refused(f"only {len(rows_earlier)} matches")
        points_earlier, points_later = earlier.points[rows_earlier], later.points[rows_later]
        forward = self.resect(points_earlier, later.pixels[rows_later])
        if isinstance(forward, str):
            return refused(forward)
        backward = self.resect(points_later, earlier.pixels[rows_earlier])
        if isinstance(backward, str):
            return refused(f"backwards {backward}", len(forward.inliers))
        inliers = min(len(forward.inliers), len(backward.inliers))
        scale = (
            _scale(points_earlier, points_later, forward, backward)
            if self.thresholds.has_units
            else 1.0
        )
        if scale is None:
            return refused("few corners have points in both views", inliers)
        T_again = backward.T_camera_points.copy()
        T_again[:3, 3] *= scale
        difference = forward.T_camera_points @ T_again
        rotation_deg = float(np.rad2deg(rotation_angle(difference[:3, :3])))
        depth = min(forward.depth, scale * backward.depth)
        translation_ratio = length_of(difference[:3, 3]) / depth
        if (
            rotation_deg > self.thresholds.agreement_deg
            or translation_ratio > self.thresholds.agreement_ratio
        ):
            reason = f"both directions differ by {rotation_deg:.1f} degrees and {translation_ratio:.0%} of the depth"
            return refused(reason, inliers)
        T_forward = invert(forward.T_camera_points)
        (T_middle,) = interpolate(
            np.stack([T_forward, T_again]), np.array([0.0, 1.0]), np.array([0.5])
        )
        again = backward.sigmas * np.repeat([1.0, scale], 3)
        sigmas = self._sigmas(T_middle, depth, difference, forward.sigmas, again)
        measured = RelativePose(earlier.index, later.index, T_middle, sigmas, LOOP_SOURCE)
        shared = np.union1d(forward.inliers, backward.inliers)
        corners = np.column_stack([rows_earlier[shared], rows_later[shared]])
        pixels = np.stack([earlier.pixels[corners[:, 0]], later.pixels[corners[:, 1]]], axis=1)
        return Loop(measured, inliers, score, scale, corners, pixels)

    def resect(self, points: NDArray[np.float32], pixels: NDArray[np.float32]) -> Sighting | str:
        """The camera that sees points ``(M, 3)``, NaN where unknown, at pixels ``(M, 2)``; or why not."""
        thresholds, K = self.thresholds, self._intrinsics.K
        known = np.flatnonzero(np.isfinite(points).all(axis=1))
        points_known = points[known].astype(np.float64)
        pixels_known = pixels[known].astype(np.float64)
        if len(known) < thresholds.min_inliers:
            return f"only {len(known)} matches have a trusted depth"
        tolerance = thresholds.reprojection_px
        T_start, inliers = consensus(
            points_known, pixels_known, K, _RANSAC_ITERATIONS, tolerance, self._seed
        )
        count = len(inliers)
        if count < thresholds.min_inliers or count < thresholds.min_inlier_ratio * len(known):
            return f"only {count} of {len(known)} matches are inliers"
        size = [self._intrinsics.width, self._intrinsics.height]
        extent = pixels_known[inliers].std(axis=0) / size
        if extent[0] < _MIN_SPREAD_RATIO or extent[1] < _MIN_SPREAD_RATIO / 2:
            return f"{count} inliers in a small part of the image"
        seen = resect([T_start], points_known[inliers], pixels_known[inliers], K)
        depth = median(points_known[inliers, 2])
        return Sighting(seen.T_camera_world, seen.sigmas, known[inliers], depth)

    def _sigmas(
        self,
        T_a_b: FloatArray,
        depth: float,
        difference: FloatArray,
        forward: FloatArray,
        backward: FloatArray,
    ) -> FloatArray:
        """Sigmas ``(6,)`` in camera b: of corners, of learned depth, and half the difference of both directions.

        Both directions use the same corners, whose errors are correlated: averaging does not reduce
        the sigmas.
        """
        corners = _CORNER_SIGMA_WIDENING * np.hypot(forward, backward)
        disagreement = tangent(difference[None])[0] / 2
        length_sigma = _LENGTH_RELATIVE_SIGMA * length_of(T_a_b[:3, 3])
        translation_floor = np.hypot(self.thresholds.translation_floor_ratio * depth, length_sigma)
        floors = np.repeat([np.deg2rad(self.thresholds.rotation_floor_deg), translation_floor], 3)
        return np.linalg.norm([corners, disagreement, floors], axis=0)


def matches(
    first: View, second: View, thresholds: LoopThresholds
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of mutual nearest neighbours by Hamming distance that pass Lowe's ratio test."""
    distance = hamming(first.descriptors, second.descriptors)
    if min(distance.shape) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    rows, nearest = np.arange(len(distance)), distance.argmin(axis=1)
    best = distance[rows, nearest]
    kept = (distance.argmin(axis=0)[nearest] == rows) & (best <= thresholds.max_hamming)
    distance[rows, nearest] = np.inf
    kept &= best < _RATIO * distance.min(axis=1)
    return rows[kept], nearest[kept]


def _scale(
    points_first: NDArray[np.float32],
    points_second: NDArray[np.float32],
    forward: Sighting,
    backward: Sighting,
) -> float | None:
    """The unit of the second view in that of the first, by the depths of points that both have."""
    both = np.intersect1d(forward.inliers, backward.inliers)
    if len(both) < _LEAST_SCALES:
        return None
    seen_by_second = apply(forward.T_camera_points, points_first[both].astype(np.float64))[:, 2]
    seen_by_first = apply(backward.T_camera_points, points_second[both].astype(np.float64))[:, 2]
    by_second = np.median(seen_by_second / points_second[both, 2])
    by_first = np.median(points_first[both, 2] / seen_by_first)
    return float(np.sqrt(by_second * by_first))
