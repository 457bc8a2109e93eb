"""Learned depth as a prior of points: what depths of an image are to each other, nothing about the unit of the map.

Depths of one image fit each other much better than the depths of two images: they share an unknown unit. So an
adjustment leaves out what the depths of an image have in common. What remains is still no independent error of each
point, so that it weighs less where rays know a depth as well.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray, invert

DEPTH_SIGMA = 0.3  # of the logarithm of learned depth
HUBER = 1.5  # sigmas beyond which residuals of an adjustment weigh less
_SETTLED = np.deg2rad(1.0)  # angle between rays of a point with parallax
_LEAST_POINTS = 20


class Parallax:
    """Of ``N`` points: the first ``centre`` that saw each ``(N, 3)``, NaN for none, and ``angle`` ``(N,)``.

    The angle is the widest between that first ray of a point and others, radians.
    """

    def __init__(self, points: FloatArray) -> None:
        """Before any camera sees the points ``(N, 3)``, which are in the world."""
        self._points = points
        self._cosine = np.ones(len(points))
        self.centre = np.full_like(points, np.nan)

    def see(self, T_camera_world: FloatArray, rows: NDArray[np.int64]) -> None:
        """The next camera in time order sees the points of these rows."""
        camera, points = invert(T_camera_world)[:3, 3], self._points[rows]
        fresh = rows[np.isnan(self.centre[rows, 0])]
        self.centre[fresh] = camera
        first, now = points - self.centre[rows], points - camera
        lengths = np.sqrt((first**2).sum(axis=1) * (now**2).sum(axis=1))
        cosine = (first * now).sum(axis=1) / np.maximum(lengths, 1e-12)
        self._cosine[rows] = np.minimum(self._cosine[rows], cosine)

    @property
    def angle(self) -> FloatArray:
        """Radians ``(N,)``."""
        return np.asarray(np.arccos(np.clip(self._cosine, -1.0, 1.0)))

    @property
    def settled(self) -> NDArray[np.bool_]:
        """Which points have parallax ``(N,)``."""
        return np.asarray(self._cosine < np.cos(_SETTLED))

    def by_rays(self, pixel_angle: float) -> FloatArray:
        """Sigmas of the logarithm of depth ``(N,)`` by rays that are known to ``pixel_angle`` radians."""
        return np.asarray(pixel_angle / np.maximum(self.angle, 1e-9))

    def prior_sigma(self, pixel_angle: float) -> FloatArray:
        """The same by learned depth ``(N,)``: errors that points share do not pull at what rays know."""
        return np.asarray(DEPTH_SIGMA * (1.0 + (DEPTH_SIGMA / self.by_rays(pixel_angle)) ** 2))

    def spread(self, pixel_angle: float) -> FloatArray:
        """One sigma of each point along its first ray ``(N, 3)``, if rays are known to ``pixel_angle`` radians."""
        sigma = np.minimum(self.by_rays(pixel_angle), DEPTH_SIGMA)
        return np.asarray(sigma[:, None] * (self._points - self.centre))


def unit_for_new(ratios: FloatArray, by_rays: FloatArray) -> float:
    """The unit of a map per learned depth of an image, for new points of this image: the weighted median.

    Args:
        ratios: of the depth of known points in the map over their learned depth ``(M,)``, positive.
        by_rays: sigmas of the logarithms of the depths in the map ``(M,)``.
    """
    if len(ratios) < _LEAST_POINTS:
        return 1.0
    order = np.argsort(ratios)
    weight = np.cumsum(1.0 / (DEPTH_SIGMA**2 + by_rays[order] ** 2))
    return float(ratios[order[np.searchsorted(weight, 0.5 * weight[-1])]])
