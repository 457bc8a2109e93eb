"""Learned depth as a prior of points, until their rays have parallax.

The depths of one image are right relative to each other, but share an unknown unit: only the former is used where
points with parallax know the unit of the map (as the affine alignment of depth maps, here of a scale alone).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray, invert

SIGMA = 0.3  # of the logarithm of learned depth
_SETTLED = np.deg2rad(1.0)  # angle of rays from which on they know the depth better
_LEAST_POINTS = 20
_ANCHOR = 0.9  # exponent by which a unit returns to that of learned depth where no point with parallax holds it


@dataclass(frozen=True)
class Parallax:
    """The first ``centre`` that saw each point ``(N, 3)``, NaN for none, and the widest ``angle`` of its ray to others.

    Angles ``(N,)`` are in radians.
    """

    centre: FloatArray
    angle: FloatArray

    @classmethod
    def of(
        cls, points: FloatArray, T_camera_world: Sequence[FloatArray], track_ids: Sequence[NDArray[np.int64]]
    ) -> Parallax:
        """Of points ``(N, 3)`` in the world, by cameras in time order and the rows of the points that each sees."""
        centre, cosine = np.full_like(points, np.nan), np.ones(len(points))
        for T, tracks in zip(T_camera_world, track_ids, strict=True):
            camera = invert(T)[:3, 3]
            fresh = tracks[np.isnan(centre[tracks, 0])]
            centre[fresh] = camera
            first, now = points[tracks] - centre[tracks], points[tracks] - camera
            lengths = np.sqrt((first**2).sum(axis=1) * (now**2).sum(axis=1))
            cosine[tracks] = np.fmin(cosine[tracks], (first * now).sum(axis=1) / np.maximum(lengths, 1e-12))
        return cls(centre, np.arccos(np.clip(cosine, -1.0, 1.0)))

    @property
    def settled(self) -> NDArray[np.bool_]:
        """Which points have parallax ``(N,)``."""
        return np.asarray(self.angle > _SETTLED)

    def spread(self, points: FloatArray, pixel_angle: float) -> FloatArray:
        """One sigma of each point along its first ray ``(N, 3)``, where an angle is known to ``pixel_angle`` radians."""
        sigma = np.minimum(pixel_angle / np.maximum(self.angle, 1e-9), SIGMA)
        return np.asarray(sigma[:, None] * (points - self.centre))


def unit_of(ratios: FloatArray, settled: NDArray[np.bool_]) -> float:
    """The unit of the map per learned depth of one image, for its points without parallax.

    Args:
        ratios: depth in the map over learned depth ``(M,)``, positive.
        settled: which of these points have parallax ``(M,)``.
    """
    loose = ratios[~settled]
    if not len(loose):
        return 1.0
    return float(np.median(loose)) ** (1.0 if settled.sum() >= _LEAST_POINTS else _ANCHOR)
