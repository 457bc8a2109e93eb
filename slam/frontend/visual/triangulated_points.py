"""Points that a step triangulated. With the points of the step before they give the ratio of both lengths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.geometry.robust import mad_sigma, weighted_median
from slam.geometry.se3 import FloatArray

_LEAST_COMMON = 12


@dataclass(frozen=True)
class TriangulatedPoints:
    """``M`` scene points that a step triangulated, by the identifiers of their tracks ``track_ids`` ``(M,)``.

    z-depths ``(M,)`` in both cameras are in units of the step's length, ``relative_sigma`` ``(M,)`` is that of both.
    """

    track_ids: NDArray[np.int64]
    depth_previous: FloatArray
    depth_current: FloatArray
    relative_sigma: FloatArray

    def length_ratio(self, earlier: TriangulatedPoints) -> tuple[float, float] | None:
        """Log of this step's length over that of an earlier one that ends where this begins, with its sigma.

        In the frame between, a point's depth is ``|t| z`` by either step; None with too few common points.
        """
        _, first, second = np.intersect1d(earlier.track_ids, self.track_ids, assume_unique=True, return_indices=True)
        if len(first) < _LEAST_COMMON:
            return None
        logarithms = np.log(earlier.depth_current[first] / self.depth_previous[second])
        weights = 1.0 / (earlier.relative_sigma[first] ** 2 + self.relative_sigma[second] ** 2)
        middle = weighted_median(logarithms, weights)
        deviation = mad_sigma(logarithms - middle)
        return middle, deviation / float(np.sqrt(len(first)))
