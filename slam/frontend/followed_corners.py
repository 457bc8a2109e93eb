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
from slam.geometry.se3 import FloatArray

# corners of plain walls creep, and windows beyond the border slip: both bend a focal length by 3 %
_SEARCH = Search(
    side=16, levels=4, limits=(20, 0.02), back=None, error_px=0.5, norm=np.inf, texture=1e-4
)
_CORNERS = Texture(quality=0.01, spacing_px=10.0, block_px=5)
_MOST_CORNERS, _WIDTH_PX, _BORDER_PX = 500, 960, 8.0
_KEYFRAME_MOVED = 0.06  # of half the width, from keyframe to keyframe
_KEYFRAME_LOST = 0.5  # of the corners of the last keyframe


@dataclass(frozen=True)
class FollowedCorners:
    """``S`` sightings: rows of keyframes and points ``(S,)``, ``image`` ``(S, 2)`` in half widths from the middle."""

    keyframe: NDArray[np.int64]
    point: NDArray[np.int64]
    image: FloatArray

    def __len__(self) -> int:
        return len(self.keyframe)

    def shared(self, keyframe: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of the points that the keyframe before shows as well, in that and in this one."""
        before = np.flatnonzero(self.keyframe == keyframe - 1)
        own = np.flatnonzero(self.keyframe == keyframe)
        _, first, second = np.intersect1d(self.point[before], self.point[own], return_indices=True)
        return before[first], own[second]

    def chosen(self, rows: NDArray[Any], least: int) -> tuple[FollowedCorners, NDArray[np.int64]]:
        """Those of points that keep so many, numbered anew, and the points that are kept."""
        keyframe, point, image = self.keyframe[rows], self.point[rows], self.image[rows]
        often = np.bincount(point)[point] >= least
        points, numbers = np.unique(point[often], return_inverse=True)
        return FollowedCorners(keyframe[often], numbers, image[often]), points


def follow(frames: Iterable[Frame]) -> tuple[FollowedCorners, float]:
    """Corners in the keyframes of some frames, and the size of a pixel in half widths."""
    rows: list[FloatArray] = []
    pixels, ids = np.zeros((0, 2), np.float32), np.zeros(0, np.int64)
    last, last_ids, sought, width, before = pixels, ids, 0, 1, None
    for frame in frames:
        frame = _narrow(frame)
        height, width = frame.grey.shape
        if before is not None:
            pixels, kept = track(before, frame.grey, pixels, _SEARCH)
            inner = height - 2 * _BORDER_PX, width - 2 * _BORDER_PX
            kept &= are_inside(pixels - _BORDER_PX, inner) & ~frame.is_fixed(pixels)
            pixels, ids = pixels[kept], ids[kept]
        before = frame.grey
        _, own, at_last = np.intersect1d(ids, last_ids, return_indices=True)
        moved = np.linalg.norm(pixels[own] - last[at_last], axis=1)
        if (
            len(own) > _KEYFRAME_LOST * len(last_ids)
            and median(moved) < _KEYFRAME_MOVED * width / 2
        ):
            continue
        corners = new_corners(frame, pixels, _MOST_CORNERS - len(pixels), _CORNERS)
        pixels = np.concatenate([pixels, corners])
        ids = np.concatenate([ids, sought + np.arange(len(corners))])
        sought += len(corners)
        last, last_ids = pixels, ids
        image = (pixels - [(width - 1) / 2, (height - 1) / 2]) * (2.0 / width)
        rows.append(np.column_stack([np.full(len(ids), len(rows)), ids, image]))
    table = np.concatenate(rows) if rows else np.zeros((0, 4))
    keyframes, points = table[:, :2].T.astype(np.int64)
    return FollowedCorners(keyframes, points, table[:, 2:]), 2.0 / width


def _narrow(frame: Frame) -> Frame:
    """The same image, at most so wide that following its corners is quick."""
    height, width = frame.image.shape[:2]
    narrow = min(width, _WIDTH_PX)
    return frame.resized(narrow, round(height * narrow / width))
