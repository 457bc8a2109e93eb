"""Verification of a loop candidate: perspective-n-point on learned depth, in both directions.

All thresholds are independent of scale: pixels, ratios, degrees, and lengths over the depth of the points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam.frames import LOOP_SOURCE, Intrinsics, RelativePose, View
from slam.geometry.resection import Resection, consensus, refine
from slam.geometry.se3 import FloatArray, invert, make, rotation_angle
from slam.loops.descriptors import hamming
from slam.loops.thresholds import LoopThresholds

_RATIO = 0.85  # largest ratio of nearest to second nearest descriptor distance
_RANSAC_ITERATIONS = 200  # RANSAC iterations of PnP
_CORNER_SIGMA_WIDENING = 1.25  # factor on the sigmas by corners
_ROTATION_FLOOR_DEG = 0.02  # least rotation sigma, degrees
_TRANSLATION_FLOOR_RATIO = 0.0003  # least translation sigma over the depth
_LENGTH_RELATIVE_SIGMA = 0.04  # translation sigma over the translation
_MIN_SPREAD_RATIO = 0.1  # least standard deviation of the inliers' columns over the image width


@dataclass(frozen=True)
class Loop:
    """A verified loop; ``inliers`` is the smaller of both directions."""

    measured: RelativePose
    inliers: int
    score: float

    @property
    def ends(self) -> tuple[int, int]:
        """Earlier and later frame."""
        return self.measured.from_index, self.measured.to_index

    def widened(self, factor: float) -> Loop:
        """The same loop with larger sigmas."""
        return replace(self, measured=replace(self.measured, sigmas=factor * self.measured.sigmas))

    def refused(self, reason: str) -> RejectedLoop:
        """The same loop, rejected for a reason."""
        return RejectedLoop(*self.ends, reason, self.score, self.inliers, self.measured.T_from_to)


@dataclass(frozen=True)
class RejectedLoop:
    """A rejected candidate or loop, with what was measured of it."""

    from_index: int
    to_index: int
    reason: str
    score: float
    inliers: int = 0
    T_from_to: FloatArray | None = None

    def scaled(self, scale: float) -> RejectedLoop:
        """The same in another unit: the translation times ``scale``."""
        if self.T_from_to is None:
            return self
        return replace(self, T_from_to=make(self.T_from_to[:3, :3], scale * self.T_from_to[:3, 3]))


class LoopVerifier:
    """Measures ``T_earlier_later`` between two views of one camera, in the unit of their points."""

    def __init__(
        self,
        thresholds: LoopThresholds,
        intrinsics: Intrinsics,
        seed: int = 0,
    ) -> None:
        self._thresholds = thresholds
        self._intrinsics = intrinsics
        self._seed = seed

    def verify(self, earlier: View, later: View, score: float) -> Loop | RejectedLoop:
        """Measure the pose of the later view in the earlier one, or reject it with a reason."""
        rows_earlier, rows_later = matches(earlier, later, self._thresholds)

        def refused(reason: str, inliers: int = 0, T: FloatArray | None = None) -> RejectedLoop:
            return RejectedLoop(earlier.index, later.index, reason, score, inliers, T)

        if len(rows_earlier) < self._thresholds.min_inliers:
            return refused(f"only {len(rows_earlier)} matches")
        forward = self.resect(earlier.points[rows_earlier], later.pixels[rows_later])
        if isinstance(forward, str):
            return refused(forward)
        backward = self.resect(later.points[rows_later], earlier.pixels[rows_earlier])
        T_earlier_later = invert(forward.T_image_points)
        if isinstance(backward, str):
            return refused(f"backwards {backward}", forward.inliers, T_earlier_later)
        inliers = min(forward.inliers, backward.inliers)
        difference = forward.T_image_points @ backward.T_image_points
        rotation_deg = float(np.rad2deg(rotation_angle(difference[:3, :3])))
        depth = min(forward.depth, backward.depth)
        translation_ratio = float(np.linalg.norm(difference[:3, 3])) / depth
        if rotation_deg > self._thresholds.agreement_deg or translation_ratio > self._thresholds.agreement_ratio:
            reason = f"both directions differ by {rotation_deg:.1f} degrees and {translation_ratio:.0%} of the depth"
            return refused(reason, inliers, T_earlier_later)
        T_middle = _halfway(T_earlier_later, backward.T_image_points)
        sigmas = self._sigmas(T_middle, depth, difference, forward, backward)
        measured = RelativePose(earlier.index, later.index, T_middle, sigmas, LOOP_SOURCE)
        return Loop(measured, inliers, score)

    def resect(self, points: NDArray[np.float32], pixels: NDArray[np.float32]) -> Sighting | str:
        """The camera pose from ``points`` ``(M, 3)`` at ``pixels`` ``(M, 2)``, or the reason for none.

        Points with NaN are left out.
        """
        thresholds = self._thresholds
        known = np.isfinite(points).all(axis=1)
        points_known, pixels_known = points[known].astype(np.float64), pixels[known].astype(np.float64)
        if len(points_known) < thresholds.min_inliers:
            return f"only {len(points_known)} matches have a trusted depth"
        K = self._intrinsics.K
        found = consensus(points_known, pixels_known, K, _RANSAC_ITERATIONS, thresholds.reprojection_px, self._seed)
        count = 0 if found is None else len(found[2])
        if found is None or count < thresholds.min_inliers or count < thresholds.min_inlier_ratio * len(points_known):
            return f"only {count} of {len(points_known)} matches are inliers"
        extent = pixels_known[found[2]].std(axis=0) / [self._intrinsics.width, self._intrinsics.height]
        if extent[0] < _MIN_SPREAD_RATIO or extent[1] < _MIN_SPREAD_RATIO / 2:
            return f"{count} inliers in a small part of the image"
        return Sighting(refine(points_known, pixels_known, K, found), float(np.median(points_known[found[2], 2])))

    def _sigmas(
        self, T_a_b: FloatArray, depth: float, difference: FloatArray, forward: Sighting, backward: Sighting
    ) -> FloatArray:
        """Sigmas ``(6,)`` in camera b: of corners, of learned depth, and half the difference of both directions.

        Both directions use the same corners, whose errors are correlated: averaging does not reduce the sigmas.
        """
        corners = _CORNER_SIGMA_WIDENING * np.hypot(forward.resection.sigmas, backward.resection.sigmas)
        rotation = Rotation.from_matrix(difference[:3, :3]).as_rotvec()
        disagreement = np.concatenate([rotation, difference[:3, 3]]) / 2
        length_sigma = _LENGTH_RELATIVE_SIGMA * float(np.linalg.norm(T_a_b[:3, 3]))
        floors = np.repeat(
            [np.deg2rad(_ROTATION_FLOOR_DEG), np.hypot(_TRANSLATION_FLOOR_RATIO * depth, length_sigma)], 3
        )
        return np.asarray(np.linalg.norm([corners, disagreement, floors], axis=0))


@dataclass(frozen=True)
class Sighting:
    """Points resected in an image; ``depth`` is their median z-depth in the camera that measured them."""

    resection: Resection
    depth: float

    @property
    def T_image_points(self) -> FloatArray:
        """Transform ``(4, 4)`` of the points to the camera of the image."""
        return self.resection.T_camera_points

    @property
    def inliers(self) -> int:
        """Number of inliers."""
        return len(self.resection.inliers)


def matches(first: View, second: View, thresholds: LoopThresholds) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of mutual nearest neighbours by Hamming distance that pass Lowe's ratio test."""
    if min(len(first), len(second)) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    distance = hamming(first.descriptors, second.descriptors)
    rows, nearest = np.arange(len(first)), distance.argmin(axis=1)
    best = distance[rows, nearest]
    kept = (distance.argmin(axis=0)[nearest] == rows) & (best <= thresholds.max_hamming)
    distance[rows, nearest] = np.inf
    kept &= best < _RATIO * distance.min(axis=1)
    return rows[kept], nearest[kept]


def _halfway(T_a_b: FloatArray, T_a_b_again: FloatArray) -> FloatArray:
    """The mean of two close measurements of one transform."""
    R_a_b = T_a_b[:3, :3]
    half = Rotation.from_rotvec(0.5 * Rotation.from_matrix(R_a_b.T @ T_a_b_again[:3, :3]).as_rotvec())
    return make(R_a_b @ half.as_matrix(), 0.5 * (T_a_b[:3, 3] + T_a_b_again[:3, 3]))
