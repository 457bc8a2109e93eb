"""Sparse optical flow: Shi-Tomasi corners, pyramidal Lucas-Kanade, forward-backward check.

With a flow predicted from learned depth and the last motion, corners are tracked in the image warped back by it. Those
that are not found there and back, as on other cars, are tracked in the image as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.config.sections import VisualOdometryConfig
from slam.frames import Frame, Grey, Mask, nearest, resized_mask
from slam.frontend.sparse_flow import Pixels, are_inside, lucas_kanade, new_corners
from slam.frontend.visual.predicted_flow import PredictedFlow
from slam.geometry.se3 import FloatArray

# displacements that remain after the predicted flow are small
_PREDICTED_LEVELS = 2
_LIMITS = 30, 0.01  # most iterations, and the shift in pixels below which they end
_CORNER_BLOCK_PX = 5
_CORNER_QUALITY = 0.008  # least corner strength over that of the strongest corner of a tile
_WIDE_WINDOW_PX = 31  # side of the window after most tracks were lost, pixels
_PYRAMID_LEVELS = 4  # image pyramid levels above the full image
_FORWARD_BACKWARD_PX = 0.5  # largest forward-backward tracking error, pixels
_WINDOW_PX = 11  # side of the Lucas-Kanade window, pixels


@dataclass(frozen=True)
class Tracks:
    """The same ``M`` scene points in two images: pixels ``(M, 2)`` each, and ``track_ids`` ``(M,)``.

    A corner keeps its identifier from frame to frame for as long as it is tracked. So many were ``sought``.
    """

    previous: FloatArray
    current: FloatArray
    track_ids: NDArray[np.int64]
    sought: int

    def __len__(self) -> int:
        return len(self.track_ids)


@dataclass(frozen=True)
class Corners:
    """Corners of one image: pixels ``(M, 2)`` and ``track_ids`` ``(M,)``."""

    pixels: Pixels
    track_ids: NDArray[np.int64]


class CornerTracker:
    """Tracks corners through one sequence and detects new ones where tracks were lost."""

    def __init__(self, config: VisualOdometryConfig) -> None:
        self._config = config
        self._corners: dict[int, Corners] = {}  # of the last frames
        self._next_track_id = 0
        self._frames_kept = config.rotation_baseline_steps + 2

    def track(
        self,
        previous: Frame,
        current: Frame,
        predicted_flow: PredictedFlow | None = None,
        standing: Mask | None = None,
    ) -> Tracks:
        """Corners of ``previous`` tracked to ``current``.

        The flow between them may be predicted; pixels that are ``standing`` ``(h, w)`` do not belong to the world.
        """
        corners = self._corners.get(previous.index)
        if corners is None:
            corners = self._filled(previous, Corners(np.zeros((0, 2), np.float32), np.zeros(0, np.int64)), standing)
        forward, kept = self._tracked(previous, current, corners.pixels, predicted_flow)
        if standing is not None:
            kept &= ~nearest(resized_mask(standing, *current.grey.shape[::-1]), forward)
        track_ids = corners.track_ids[kept]
        if current.index not in self._corners:
            self._filled(current, Corners(forward[kept], track_ids), standing)
        before, now = corners.pixels[kept].astype(np.float64), forward[kept].astype(np.float64)
        return Tracks(before, now, track_ids, len(kept))

    def track_across(self, previous: Frame, current: Frame, predicted_flow: PredictedFlow) -> Callable[[], Tracks]:
        """Prepare to track corners of ``previous`` to a frame some steps later.

        The function returned does it, in any thread.
        """
        corners = self._corners.get(previous.index)
        following = min((index for index in self._corners if index > previous.index), default=None)
        if corners is None or following is None:
            return lambda: Tracks(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int64), 0)
        tracked = np.isin(corners.track_ids, self._corners[following].track_ids)
        points, track_ids = corners.pixels[tracked], corners.track_ids[tracked]

        def find() -> Tracks:
            target = _warped(current.grey, _WINDOW_PX, predicted_flow)
            pixels, kept = self._first_flow(previous.grey, current.grey, points, [target])
            before, now = points[kept].astype(np.float64), pixels[kept].astype(np.float64)
            return Tracks(before, now, track_ids[kept], len(kept))

        return find

    def _tracked(
        self, first: Frame, second: Frame, points: Pixels, predicted_flow: PredictedFlow | None
    ) -> tuple[Pixels, NDArray[np.bool_]]:
        """Points ``(M, 2)`` tracked to the second frame, and which are reliable; with wide windows if few."""
        pixels, kept = self._flow(first.grey, second.grey, points, _WINDOW_PX, predicted_flow)
        if kept.sum() < self._config.few_corners:
            exposed = _histogram_matched(second.grey, first.grey)
            pixels_wide, kept_wide = self._flow(first.grey, exposed, points, _WIDE_WINDOW_PX, predicted_flow)
            if kept_wide.sum() > kept.sum():
                return pixels_wide, kept_wide
        return pixels, kept

    def _filled(self, frame: Frame, arrived: Corners, standing: Mask | None) -> Corners:
        """Keep the corners tracked to a frame, and new ones up to the largest number."""
        config, next_id = self._config, self._next_track_id
        pixels, track_ids = arrived.pixels, arrived.track_ids
        room = config.max_corners - len(pixels)
        if room > 0:
            wanted = room, _CORNER_QUALITY, config.corner_spacing_px, _CORNER_BLOCK_PX
            fresh = new_corners(frame.grey, pixels, *wanted, standing)
            pixels = np.concatenate([pixels, fresh])
            track_ids = np.concatenate([track_ids, next_id + np.arange(len(fresh))])
            next_id += len(fresh)
        corners = Corners(pixels, track_ids)
        self._corners[frame.index], self._next_track_id = corners, next_id
        for index in sorted(self._corners)[: -self._frames_kept]:
            del self._corners[index]
        return corners

    def _flow(
        self, first: Grey, second: Grey, points: Pixels, side: int, predicted_flow: PredictedFlow | None
    ) -> tuple[Pixels, NDArray[np.bool_]]:
        """Points ``(M, 2)`` tracked directly or through the predicted flow, and which are reliable."""
        plain = _Target(second, side, _PYRAMID_LEVELS)
        targets = [plain] if predicted_flow is None else [_warped(second, side, predicted_flow), plain]
        return self._first_flow(first, second, points, targets)

    def _first_flow(
        self, first: Grey, second: Grey, points: Pixels, targets: Sequence[_Target]
    ) -> tuple[Pixels, NDArray[np.bool_]]:
        """Points ``(M, 2)`` by the first target in which they pass the forward-backward check; which do ``(M,)``."""
        pixels, kept = points.copy(), np.zeros(len(points), dtype=bool)
        for target in targets:
            tried = np.flatnonzero(~kept)
            if len(tried) == 0:
                break
            window = target.side, target.levels, _LIMITS
            forward, found = lucas_kanade(first, target.image, points[tried], *window)
            tried, forward = tried[found], forward[found]
            if len(tried) == 0:
                continue
            backward, found_back = lucas_kanade(target.image, first, forward, *window)
            error = np.abs(backward - points[tried]).max(axis=1)
            returned = found_back & (error < _FORWARD_BACKWARD_PX)
            pixels[tried[returned]], kept[tried[returned]] = target.in_current(forward[returned]), True
        return pixels, kept & are_inside(pixels, second.shape)


@dataclass(frozen=True)
class _Target:
    """An image in which points are searched with windows of ``side`` over ``levels`` of its pyramid.

    ``in_current`` takes pixels of that image to the later one.
    """

    image: Grey
    side: int
    levels: int
    in_current: Callable[[Pixels], Pixels] = lambda pixels: pixels


def _warped(second: Grey, side: int, predicted_flow: PredictedFlow) -> _Target:
    """The later image warped back by the predicted flow."""
    return _Target(predicted_flow.warp_back(second), side, _PREDICTED_LEVELS, predicted_flow.in_current)


def _histogram_matched(grey: Grey, other: Grey) -> Grey:
    """An image ``(H, W)`` with its histogram matched to that of another."""
    ranks, ranks_other = (np.cumsum(np.bincount(image.ravel(), minlength=256)) / image.size for image in (grey, other))
    levels = np.interp(ranks, ranks_other, np.arange(256.0))
    return np.asarray(cv2.LUT(grey, np.rint(levels).astype(np.uint8)))
