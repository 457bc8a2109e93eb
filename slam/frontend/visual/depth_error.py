"""What the corners of a drive show of its error of learned depth over distance.

Networks see far things too near, and err more the farther they are: on streets that they were not
trained on by a third beyond 40 m. One scale for all distances would then depend on whether most
corners are near or far. So the logarithm of learned over triangulated depth is counted by learned
depth; its median is the bias that is taken out before depth is compared with anything, its spread
without that of triangulation the sigma (``docs/design/visual-front-end.md``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from slam.frames import DepthMap
from slam.geometry.robust import weighted_median
from slam.geometry.se3 import FloatArray, IntArray

# learned depth is counted in half octaves, in the unit of the networks
_DEPTHS = 2.0 ** np.arange(-6.0, 9.0, 0.5)
_STEP = 0.05
_LOGARITHMS = np.arange(-1.5, 1.5 + _STEP / 2, _STEP)
# decay a step: a half-life of 34 steps
_KEPT = 0.98
# corners that an unbiased depth would have shown at every distance before the drive
_PRIOR_CORNERS = 40.0
_PRIOR_SIGMA = 0.2
_LEAST_SIGMA = 0.1
_USUAL_SIGMA = 0.15
_USUAL_FAR_SIGMA = 0.25
_FAR_CORNERS = 0.05  # least corners over the most of a distance
# what moves along with the camera, as a car beside it, is triangulated far behind its place: that is
# no error of learned depth
_LEAST_RATIO = float(np.exp(_LOGARITHMS[0]))
_SURE_SIGMAS = 2.0


@dataclass(frozen=True, eq=False)
class DepthError:
    """Corners of the last steps by learned depth and by log of learned over triangulated depth ``(D, L)``, decayed.

    Those that triangulation hardly measures count less. ``noise`` ``(D,)`` is the sum of its
    sigmas.
    """

    corners: FloatArray = field(default_factory=lambda: np.zeros((len(_DEPTHS), len(_LOGARITHMS))))
    noise: FloatArray = field(default_factory=lambda: np.zeros(len(_DEPTHS)))

    def corrected(self, depth: DepthMap | FloatArray) -> FloatArray:
        """Learned depth of any shape without its bias; NaN stays."""
        logarithm = np.log(np.where(depth > 0, depth, np.nan))
        return np.exp(logarithm - np.interp(logarithm, np.log(_DEPTHS), self.bias))

    def sigma(self, depth: FloatArray) -> FloatArray:
        """Relative sigma of learned depth of any shape, without its bias."""
        return np.interp(np.log(np.where(depth > 0, depth, 1.0)), np.log(_DEPTHS), self._spread)

    def length(
        self, learned: FloatArray, triangulated: FloatArray, relative_sigma: FloatArray
    ) -> tuple[float, float]:
        """Length of a motion in the unit of learned depth, and the relative spread of single corners about it.

        Args:
            learned: positive depth ``(M,)`` as the network gives it.
            triangulated: positive depth ``(M,)`` in units of the motion's length.
            relative_sigma: that of triangulated depth ``(M,)``.
        """
        logarithms = np.log(self.corrected(learned) / triangulated)
        weights = 1.0 / (_LEAST_SIGMA**2 + relative_sigma**2)
        centre = weighted_median(logarithms, weights)
        return float(np.exp(centre)), weighted_median(np.abs(logarithms - centre), weights)

    def with_step(
        self, learned: FloatArray, nearness: FloatArray, sigma: FloatArray, length: float
    ) -> Self:
        """The error after one more step.

        Args:
            learned: depth ``(M,)`` of corners on their epipolar lines, NaN where unknown.
            nearness: 1 over triangulated depth ``(M,)`` in units of the motion's length, without
                bias; 0 or less beyond infinity.
            sigma: of it ``(M,)``.
            length: of the motion, in the unit of learned depth.
        """
        known = np.isfinite(learned)
        farthest = nearness + _SURE_SIGMAS * sigma
        known[known] = (farthest * learned)[known] > _LEAST_RATIO * length
        ratio = learned[known] * nearness[known] / length
        spread = learned[known] * sigma[known] / length
        weights = 1.0 / (1.0 + (spread / _USUAL_SIGMA) ** 2)
        corners, noise = _KEPT * self.corners, _KEPT * self.noise
        depths = _nearest(np.log2(learned[known]), np.log2(_DEPTHS))
        np.add.at(
            corners, (depths, _nearest(np.log(np.maximum(ratio, 1e-9)), _LOGARITHMS)), weights
        )
        np.add.at(noise, depths, weights * spread)
        return type(self)(corners, noise)

    def most_too_far(self) -> float | None:
        """The largest bias towards far, less where the depth there scatters more than usual; None without corners."""
        corners = self.corners.sum(axis=1)
        bias = self.bias / np.maximum(self._spread / _USUAL_FAR_SIGMA, 1.0)
        counted = bias[corners > _FAR_CORNERS * corners.max()]
        return float(counted.max()) if len(counted) else None

    def curve(self) -> list[list[float]]:
        """Learned depth, its bias (logarithm), its relative sigma and the corners seen there, where there are many."""
        corners = self.corners.sum(axis=1)
        rows = np.column_stack([_DEPTHS, self.bias, self._spread, corners])
        return rows[corners > _PRIOR_CORNERS].tolist()

    @cached_property
    def bias(self) -> FloatArray:
        """Log of learned over true depth at each of ``_DEPTHS`` ``(D,)``.

        It is zero on the average of what corners tell of a length, which they do by the square of
        their parallax: near depth, as that of the road, keeps its unit.
        """
        median = self._quantile(0.5)
        weights = self.corners.sum(axis=1) / (self._spread * _DEPTHS) ** 2
        return median - (weights @ median / weights.sum() if weights.any() else 0.0)

    @cached_property
    def _spread(self) -> FloatArray:
        seen = 0.5 * (self._quantile(0.84) - self._quantile(0.16))
        noise = self.noise / (self.corners.sum(axis=1) + _PRIOR_CORNERS)
        return np.sqrt(np.maximum(seen**2 - noise**2, _LEAST_SIGMA**2))

    @property
    def total_spread(self) -> float | None:
        """Half of the range that holds two thirds of all logarithms; None where the drive showed few corners."""
        counts = self.corners.sum(axis=0)
        if counts.sum() < _PRIOR_CORNERS:
            return None
        low, high = np.interp([0.16, 0.84], np.cumsum(counts) / counts.sum(), _LOGARITHMS)
        return float(high - low) / 2

    def _quantile(self, share: float) -> FloatArray:
        """Quantile of the logarithms at each depth ``(D,)``, linear within their steps."""
        prior = np.exp(-0.5 * (_LOGARITHMS / _PRIOR_SIGMA) ** 2)
        cumulative = np.cumsum(self.corners + _PRIOR_CORNERS * prior / prior.sum(), axis=1)
        cumulative /= cumulative[:, -1:]
        edges = _LOGARITHMS + _STEP / 2
        return np.array([np.interp(share, row, edges) for row in cumulative])


def _nearest(values: FloatArray, places: NDArray[np.floating[Any]]) -> IntArray:
    """Row of the nearest of evenly spaced ``places`` ``(P,)`` for values ``(M,)``, beyond its ends the last."""
    rows = np.rint((values - places[0]) / (places[1] - places[0]))
    return np.asarray(np.clip(rows, 0, len(places) - 1), np.int64)
