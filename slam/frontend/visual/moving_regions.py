"""Regions of the image that move: those that recently showed dynamic objects, and those that contradict learned depth.

A car ahead stays at one place of the image for minutes. Some of its corners fit the camera's motion by chance and bias
it, but most do not: where many corners were outliers recently, the others are weighted down
(``docs/design/visual-front-end.md``).

A car that drives along with the camera keeps its corners on their epipolar lines, so geometry alone takes it for a part
of the scene, farther or nearer than it is; learned depth knows better. But learned depth errs too, over half of the
image at times, and must not cast out the scene itself. So it is believed only about a region as an object has it:
connected, of one motion, and without the majority of the road; and about all such regions together only where they do
not hold the majority of the image's parallax.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray

_CELL_PX = 8.0
_SPREAD_CELLS = 1.5
_SHARPNESS = 4.0  # power of a cell's inlier ratio over that of the whole image, by which corners weigh
# decay a step: a half-life of seven steps
_KEPT = 0.9
# weight, in corners, of the prior that a cell has the inlier ratio of the whole image
_PRIOR_CORNERS = 0.5
# side of the cells that connect corners to a region, pixels: some two spacings of corners
_REGION_CELL_PX = 24.0
_LARGEST_SHARE = 0.5
# largest deviation of the corners of a region from its own motion, over that motion
_CONSISTENCY = 0.5


@dataclass(frozen=True)
class DynamicMask:
    """Inliers and all corners of the last steps by cell of the image ``(h, w)``, decayed exponentially."""

    inliers: FloatArray
    corners: FloatArray

    @classmethod
    def empty(cls, width: int, height: int) -> Self:
        """A mask without observations for images of ``width`` x ``height`` pixels."""
        shape = int(np.ceil(height / _CELL_PX)), int(np.ceil(width / _CELL_PX))
        return cls(np.zeros(shape), np.zeros(shape))

    def weights(self, pixels: FloatArray) -> FloatArray:
        """Weights in (0, 1] ``(M,)`` of corners at ``pixels`` ``(M, 2)``."""
        if self.corners.sum() < 1.0:
            return np.ones(len(pixels))
        usual = self.inliers.sum() / self.corners.sum()
        inliers, corners = (cv2.GaussianBlur(kind, (0, 0), _SPREAD_CELLS) for kind in (self.inliers, self.corners))
        ratio = (inliers + _PRIOR_CORNERS * usual) / (corners + _PRIOR_CORNERS)
        return np.asarray(np.minimum(ratio[self._cells(pixels)] / max(usual, 1e-3), 1.0) ** _SHARPNESS)

    def updated(self, pixels: FloatArray, is_inlier: NDArray[np.bool_]) -> Self:
        """The mask after one more step, whose corners now lie at ``pixels`` ``(M, 2)``."""
        inliers, corners = _KEPT * self.inliers, _KEPT * self.corners
        cells = self._cells(pixels)
        np.add.at(corners, cells, 1.0)
        np.add.at(inliers, cells, is_inlier.astype(float))
        return type(self)(inliers, corners)

    def _cells(self, pixels: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        column, row = (np.floor(pixels.T / _CELL_PX)).astype(np.int64)
        height, width = self.corners.shape
        return np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)


def moving_corners(
    pixels: FloatArray,
    on_road: NDArray[np.bool_],
    agreeing: NDArray[np.bool_],
    contradicting: NDArray[np.bool_],
    expected_px: FloatArray,
    seen_px: FloatArray,
) -> NDArray[np.bool_]:
    """Which of the contradicting corners ``(M,)`` lie in a region that moves.

    Args:
        pixels: ``(M, 2)``, of any origin.
        on_road: corners that learned depth puts on the road ``(M,)``.
        agreeing: corners on their epipolar lines whose shift along them is as learned depth has it ``(M,)``.
        contradicting: those on their lines whose shift is another ``(M,)``.
        expected_px: the shift by learned depth ``(M,)``.
        seen_px: the shift along the line ``(M,)``, negative away from it.
    """
    moving = np.zeros(len(pixels), dtype=bool)
    if not contradicting.any():
        return moving
    cells = np.floor((pixels[contradicting] - pixels[contradicting].min(axis=0)) / _REGION_CELL_PX).astype(np.int64)
    occupied = np.zeros(tuple(cells.max(axis=0) + 1), np.uint8)
    occupied[tuple(cells.T)] = 1
    count, labels = cv2.connectedComponents(occupied, connectivity=8)
    region = labels[tuple(cells.T)]
    motion = 1.0 - seen_px[contradicting] / np.maximum(expected_px[contradicting], 1e-3)
    parallax = np.where(agreeing | contradicting, np.abs(seen_px), 0.0)
    on_road_px = np.bincount(region, (parallax * on_road)[contradicting], count)
    is_most_of_road = on_road_px > _LARGEST_SHARE * parallax[on_road].sum()
    middle = _medians(motion, region, count)
    scatter = _medians(np.abs(motion - middle[region]), region, count)
    moving[contradicting] = (~is_most_of_road & (scatter < _CONSISTENCY * np.abs(middle)))[region]
    is_most = parallax[moving].sum() > _LARGEST_SHARE * parallax.sum()
    return np.zeros_like(moving) if is_most else moving


def _medians(values: FloatArray, groups: NDArray[np.integer[Any]], count: int) -> FloatArray:
    """The median of the values ``(K,)`` of each group, ``(count,)``; 0 of an empty one."""
    order, sizes = np.lexsort((values, groups)), np.bincount(groups, minlength=count)
    first, last = np.cumsum(sizes) - sizes, len(values) - 1
    below, above = (np.minimum(first + np.maximum(half, 0), last) for half in ((sizes - 1) // 2, sizes // 2))
    return np.where(sizes > 0, 0.5 * (values[order[below]] + values[order[above]]), 0.0)
