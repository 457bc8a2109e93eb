"""Corners that are followed from keyframe to keyframe, before anything is known of the camera."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.frames import Frame
from slam.frontend.tracking import Search, Texture, are_inside, new_corners, track
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray, IntArray

# corners of plain walls creep, and windows beyond the border slip: both bend a focal length by 3 %
_SEARCH = Search(
    side=16, levels=4, limits=(20, 0.02), back=None, error_px=0.5, norm=np.inf, texture=1e-4
)
_CORNERS = Texture(quality=0.01, spacing_px=10.0, block_px=5)
_MOST_CORNERS, _WIDTH_PX, _BORDER_PX = 500, 960, 8.0
_MOST_KEYFRAMES = 450
_KEYFRAME_MOVED = 0.06  # half widths, from keyframe to keyframe
_KEYFRAME_LOST = 0.5  # of the corners of the last keyframe


@dataclass(frozen=True)
class FollowedCorners:
    """``S`` sightings: rows of keyframes and points ``(S,)``, ``image`` ``(S, 2)`` in half widths from the middle.

    ``pixel`` is the size of a pixel in half widths.
    """

    keyframe: IntArray
    point: IntArray
    image: FloatArray
    pixel: float

    def __len__(self) -> int:
        return len(self.keyframe)

    def shared(self, keyframe: int) -> tuple[IntArray, IntArray]:
        """Rows of the points that the keyframe before shows as well, in that and in this one."""
        before = np.flatnonzero(self.keyframe == keyframe - 1)
        own = np.flatnonzero(self.keyframe == keyframe)
        _, first, second = np.intersect1d(self.point[before], self.point[own], return_indices=True)
        return before[first], own[second]

    def chosen(self, rows: NDArray[Any], least: int) -> tuple[FollowedCorners, IntArray]:
        """Those of points that keep so many, numbered anew, and the points that are kept."""
        keyframe, point, image = self.keyframe[rows], self.point[rows], self.image[rows]
        often = np.bincount(point)[point] >= least
        points, numbers = np.unique(point[often], return_inverse=True)
        return FollowedCorners(keyframe[often], numbers, image[often], self.pixel), points


class CornerRecord:
    """Collects the corners of keyframes: of images so far apart that turns are told."""

    def __init__(self) -> None:
        self._last, self._last_ids = np.zeros((0, 2)), np.zeros(0, np.int64)
        self._rows: list[FloatArray] = [np.zeros((0, 4))]

    def is_far(self, ids: IntArray, image: FloatArray) -> bool:
        """Whether corners, by their identifiers ``(M,)`` and in half widths ``(M, 2)``, are far from the keyframe's."""
        _, own, at_last = np.intersect1d(ids, self._last_ids, return_indices=True)
        moved = np.linalg.norm(image[own] - self._last[at_last], axis=1)
        return len(own) <= _KEYFRAME_LOST * len(self._last_ids) or median(moved) >= _KEYFRAME_MOVED

    def keep(self, ids: IntArray, image: FloatArray) -> None:
        """Make an image a keyframe, with corners as `is_far` has them, unless there are many."""
        keyframe = len(self._rows) - 1
        if keyframe == _MOST_KEYFRAMES:
            return
        self._last, self._last_ids = image, ids
        self._rows.append(np.column_stack([np.full(len(ids), keyframe), ids, image]))

    def seen(self, pixel: float = 1.0) -> FollowedCorners:
        """All keyframes so far, and the size of a pixel in half widths."""
        table = np.concatenate(self._rows)
        keyframes, points = table[:, :2].T.astype(np.int64)
        return FollowedCorners(keyframes, points, table[:, 2:], pixel)


def follow(frames: Iterable[Frame]) -> FollowedCorners:
    """Corners in the keyframes of some frames."""
    record, pixels, ids = CornerRecord(), np.zeros((0, 2), np.float32), np.zeros(0, np.int64)
    sought, width, before = 0, 1, None
    for frame in frames:
        height, width = frame.image.shape[:2]
        ratio = min(_WIDTH_PX / width, 1.0)  # following corners of wide images takes long
        frame = frame.resized(round(ratio * width), round(ratio * height))
        height, width = frame.grey.shape
        if before is not None:
            pixels, kept = track(before, frame.grey, pixels, _SEARCH)
            inner = height - 2 * _BORDER_PX, width - 2 * _BORDER_PX
            kept &= are_inside(pixels - _BORDER_PX, inner) & ~frame.is_fixed(pixels)
            pixels, ids = pixels[kept], ids[kept]
        before = frame.grey
        middle, pixel = np.array([(width - 1) / 2, (height - 1) / 2]), 2.0 / width
        if not record.is_far(ids, (pixels - middle) * pixel):
            continue
        corners = new_corners(frame, pixels, _MOST_CORNERS - len(pixels), _CORNERS)
        pixels = np.concatenate([pixels, corners])
        ids = np.concatenate([ids, sought + np.arange(len(corners))])
        sought += len(corners)
        record.keep(ids, (pixels - middle) * pixel)
    return record.seen(2.0 / width)
