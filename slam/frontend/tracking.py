"""Sparse optical flow: Shi-Tomasi corners, pyramidal Lucas-Kanade from a predicted motion, and back again as a check.

With a flow predicted from learned depth and the last motion, corners are tracked in the image
warped back by it, for Lucas-Kanade shifts windows without stretching them
(``docs/design/visual-front-end.md``). Those that are not found there and back, as on other cars,
are tracked in the image as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise, product
from typing import NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import DepthMap, Frame, Grey, Intrinsics, resized_mask
from slam.geometry.multiview import UnitRelativePose
from slam.geometry.se3 import BoolArray, FloatArray, IntArray, invert

Pixels = NDArray[np.float32]
_TERMINATION = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT
# least eigenvalue of a window's gradients: a tenth of what OpenCV wants, for plain walls
_LEAST_TEXTURE = 1e-5
_TILES = 3, 4  # down and across: corners are spread over them
_NEAREST = 1e-6
_INVERSIONS = 2
_DEPTH_WIDTH_PX = 400
MAX_CORNERS = 800  # of a step: twice as many change no error and take twice the time
_GRID_PX = 3  # the flow is computed at every third pixel: learned depth has no finer detail
_ACROSS_PX = 1.0  # largest error of a corner over several steps, by the way across and step by step
# steps between frames whose rotation is also measured directly: halves its error
ROTATION_BASELINE = 2
LONGEST_STEP = 30  # frames across which corners are compared where nothing can be told apart
# tracks below which they are sought again, with the wide window and equal exposure
FEW_CORNERS = 60
# no corners, and the identifiers of their tracks
_NOTHING = np.zeros((0, 2), np.float32), np.zeros(0, np.int64)
_WIDE_WINDOW_PX = 31  # side of the window after most tracks were lost, pixels


class Search(NamedTuple):
    """A search by windows of ``side`` pixels over ``levels`` of the image pyramid above the full image.

    ``limits`` are most iterations, and the shift in pixels below which they end. A corner is kept
    if a search ``back`` returns to within ``error_px`` by a ``norm`` of this order. That has its
    own levels and limits and begins where corners came from; without them it is the same search,
    and begins where they were found. Windows whose gradients have a smaller least eigenvalue than
    ``texture`` are not sought.
    """

    side: int
    levels: int
    limits: tuple[int, float]
    back: tuple[int, tuple[int, float]] | None
    error_px: float
    norm: float
    texture: float = _LEAST_TEXTURE


class Texture(NamedTuple):
    """Corners by their strength over that of the strongest one of a tile, and their distance, pixels.

    ``block_px`` is the side of the surroundings by which a corner is judged.
    """

    quality: float
    spacing_px: float
    block_px: int


STEP_SEARCH = Search(side=11, levels=4, limits=(30, 0.01), back=None, error_px=0.5, norm=np.inf)
# displacements that remain after the predicted flow are small
_PREDICTED_SEARCH: Search = STEP_SEARCH._replace(levels=2)
# OpenCV computes eight columns of a window at once and those that remain one by one: 16 take half
# the time of 15
KEYFRAME_SEARCH = Search(
    side=16, levels=3, limits=(15, 0.02), back=(1, (10, 0.05)), error_px=0.7, norm=2
)
STEP_CORNERS = Texture(quality=0.008, spacing_px=11.0, block_px=5)
KEYFRAME_CORNERS = Texture(quality=0.0003, spacing_px=12.0, block_px=3)


def track(
    first: Grey, second: Grey, pixels: Pixels, search: Search, guesses: Pixels | None = None
) -> tuple[Pixels, BoolArray]:
    """Pixels ``(M, 2)`` of the first image found in the second, and which of them were found back ``(M,)``.

    Args:
        first: ``(H, W)``.
        second: of the same size.
        pixels: ``(M, 2)``.
        search: by which windows.
        guesses: where the search begins ``(M, 2)``; None is at the pixels themselves.
    """
    guesses = pixels if guesses is None else guesses
    moved, forward = _lucas_kanade(first, second, pixels, guesses, search)
    levels, limits = search.back or (search.levels, search.limits)
    start = moved if search.back is None else pixels
    back = search._replace(levels=levels, limits=limits)
    returned, backward = _lucas_kanade(second, first, moved, start, back)
    near = np.linalg.norm(returned - pixels, search.norm, axis=1) < search.error_px
    return moved, forward & backward & near


def _lucas_kanade(
    first: Grey, second: Grey, pixels: Pixels, guesses: Pixels, search: Search
) -> tuple[Pixels, BoolArray]:
    if not len(pixels):
        return pixels, np.zeros(0, np.bool_)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        pixels.reshape(-1, 1, 2),
        guesses.reshape(-1, 1, 2).copy(),
        winSize=(search.side, search.side),
        maxLevel=search.levels,
        criteria=(_TERMINATION, *search.limits),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=search.texture,
    )
    return moved.reshape(-1, 2), status.ravel().astype(bool)


def are_inside(pixels: Pixels, shape: tuple[int, ...]) -> BoolArray:
    """Which pixels ``(M, 2)`` lie in an image ``(H, W)``."""
    return np.asarray(
        (pixels >= 0).all(axis=1) & (pixels <= [shape[1] - 1, shape[0] - 1]).all(axis=1)
    )


def new_corners(
    frame: Frame, taken: Pixels, count: int, texture: Texture = KEYFRAME_CORNERS
) -> Pixels:
    """Up to ``count`` Shi-Tomasi corners ``(M, 2)``, apart from each other and from those taken.

    All tiles of the image get equally many for as long as they have some, those that are taken
    among them: one thing that is all texture would have them all, be it the world or not.

    Args:
        frame: without what is fixed to the camera, where no corner is wanted.
        taken: corners ``(K, 2)`` in the image.
        count: of new corners.
        texture: what a corner is.
    """
    if count <= 0:
        return _NOTHING[0]
    grey = frame.grey
    free = _away_from(taken, int(texture.spacing_px), grey.shape)
    if frame.fixed is not None:
        free[resized_mask(frame.fixed, *grey.shape[::-1])] = 0
    tiles, ranks = [_NOTHING[0]], [_NOTHING[1]]
    down, across = (
        pairwise(np.linspace(0, side, number + 1).astype(int))
        for side, number in zip(grey.shape, _TILES, strict=True)
    )
    for (top, bottom), (left, right) in product(down, across):
        tile = slice(top, bottom), slice(left, right)
        corners = cv2.goodFeaturesToTrack(
            grey[tile],
            count,
            texture.quality,
            texture.spacing_px,
            mask=free[tile],
            blockSize=texture.block_px,
        )
        if corners is not None:
            before = ((taken >= (left, top)) & (taken < (right, bottom))).all(axis=1).sum()
            tiles.append(corners.reshape(-1, 2) + np.array([left, top], np.float32))
            ranks.append(before + np.arange(len(corners)))
    order = np.argsort(np.concatenate(ranks), kind="stable")[:count]
    return np.concatenate(tiles)[order]


def _away_from(pixels: Pixels, radius: int, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """A mask ``(H, W)``, zero within ``radius`` of pixels ``(M, 2)`` inside of it."""
    mask = np.full(shape, 255, np.uint8)
    for centre in np.rint(pixels).astype(np.int64).tolist():
        cv2.circle(mask, centre, radius, 0, thickness=-1)
    return mask


@dataclass(frozen=True)
class Tracks:
    """The same ``M`` scene points in two images: pixels ``(M, 2)`` each, and ``track_ids`` ``(M,)``.

    A corner keeps its identifier from frame to frame for as long as it is tracked. So many were
    ``sought``.
    """

    previous: FloatArray
    current: FloatArray
    track_ids: IntArray
    sought: int

    @classmethod
    def of(cls, before: Pixels, now: Pixels, track_ids: IntArray, kept: BoolArray) -> Self:
        """Those ``kept`` ``(M,)`` of corners ``(M, 2)`` that were sought."""
        before_kept, now_kept = (pixels[kept].astype(np.float64) for pixels in (before, now))
        return cls(before_kept, now_kept, track_ids[kept], len(kept))

    def __len__(self) -> int:
        return len(self.track_ids)


class CornerTracker:
    """Tracks corners through one sequence and detects new ones where tracks were lost."""

    def __init__(self) -> None:
        # of the last frames: pixels (M, 2) and the identifiers of their tracks (M,)
        self._corners: dict[int, tuple[Pixels, IntArray]] = {}
        self._next_track_id = 0

    def track(
        self, previous: Frame, current: Frame, predicted_flow: PredictedFlow | None = None
    ) -> Tracks:
        """Corners of ``previous`` tracked to ``current``.

        Args:
            previous: the frame before.
            current: the later frame.
            predicted_flow: between them; None where nothing predicts it.
        """
        if previous.index not in self._corners:
            self._fill(previous, *_NOTHING)
        pixels, track_ids = self._corners[previous.index]
        forward, kept = _tracked(previous.grey, current.grey, pixels, predicted_flow)
        kept &= ~current.is_fixed(forward)
        if current.index not in self._corners:
            self._fill(current, forward[kept], track_ids[kept])
        return Tracks.of(pixels, forward, track_ids, kept)

    def track_across(
        self, previous: Frame, current: Frame, predicted_flow: PredictedFlow
    ) -> Callable[[], Tracks]:
        """Prepare to track corners of ``previous`` to a frame some steps later, to which they came step by step.

        The function returned does it, in any thread. It keeps corners that both ways find at the
        same place, which is half the work of tracking them back.
        """
        corners, arrived = (
            self._corners.get(frame.index, _NOTHING) for frame in (previous, current)
        )
        track_ids, rows, rows_arrived = np.intersect1d(corners[1], arrived[1], return_indices=True)
        points, by_steps = corners[0][rows], arrived[0][rows_arrived]

        def find() -> Tracks:
            images = previous.grey, predicted_flow.warp_back(current.grey)
            pixels, kept = _lucas_kanade(*images, points, points, _PREDICTED_SEARCH)
            pixels = predicted_flow.in_current(pixels)
            kept &= np.linalg.norm(pixels - by_steps, STEP_SEARCH.norm, axis=1) < _ACROSS_PX
            return Tracks.of(points, pixels, track_ids, kept)

        return find

    def _fill(self, frame: Frame, pixels: Pixels, track_ids: IntArray) -> None:
        """Keep the corners tracked to a frame, and new ones up to the largest number."""
        fresh = new_corners(frame, pixels, MAX_CORNERS - len(pixels), STEP_CORNERS)
        new_ids = self._next_track_id + np.arange(len(fresh))
        self._corners[frame.index] = (
            np.concatenate([pixels, fresh]),
            np.concatenate([track_ids, new_ids]),
        )
        self._next_track_id += len(fresh)
        for index in sorted(self._corners)[: -LONGEST_STEP - 2]:
            del self._corners[index]


def _tracked(
    first: Grey, second: Grey, points: Pixels, predicted_flow: PredictedFlow | None
) -> tuple[Pixels, BoolArray]:
    """Points ``(M, 2)`` tracked to the second image, and which are reliable ``(M,)``; with wide windows if few."""
    flows = [predicted_flow, None] if predicted_flow else [None]
    pixels, kept = _by_first_flow(first, second, points, flows)
    if kept.sum() < FEW_CORNERS:
        # the second image with its histogram matched to that of the first
        ranks_first, ranks = (
            np.cumsum(np.bincount(image.ravel(), minlength=256)) / image.size
            for image in (first, second)
        )
        levels = np.interp(ranks, ranks_first, np.arange(256.0))
        exposed = np.asarray(cv2.LUT(second, np.rint(levels).astype(np.uint8)))
        pixels_wide, kept_wide = _by_first_flow(first, exposed, points, flows, _WIDE_WINDOW_PX)
        if kept_wide.sum() > kept.sum():
            return pixels_wide, kept_wide
    return pixels, kept


def _by_first_flow(
    first: Grey,
    second: Grey,
    points: Pixels,
    flows: Sequence[PredictedFlow | None],
    side: int = STEP_SEARCH.side,
) -> tuple[Pixels, BoolArray]:
    """Points ``(M, 2)`` by the first predicted flow, or by none, with which they are found back; which are ``(M,)``."""
    pixels, kept = points.copy(), np.zeros(len(points), dtype=bool)
    for flow in flows:
        tried = np.flatnonzero(~kept)
        search = STEP_SEARCH if flow is None else _PREDICTED_SEARCH
        image = second if flow is None else flow.warp_back(second)
        moved, found_back = track(first, image, points[tried], search._replace(side=side))
        moved = moved[found_back]
        pixels[tried[found_back]], kept[tried[found_back]] = (
            moved if flow is None else flow.in_current(moved),
            True,
        )
    return pixels, kept & are_inside(pixels, second.shape)


@dataclass(frozen=True, eq=False)
class PredictedFlow:
    """Flow of the pixels of an image under a motion (``unit_pose``, ``length``) in a static scene.

    ``length`` and ``depth_previous`` ``(H, W)`` are in one unit; pixels without depth are taken as
    infinitely far.
    """

    unit_pose: UnitRelativePose
    length: float
    depth_previous: DepthMap
    intrinsics: Intrinsics

    @classmethod
    def of(
        cls, T_previous_current: FloatArray, depth_previous: DepthMap, intrinsics: Intrinsics
    ) -> Self | None:
        """By a pose in the unit of the depth; None where it has no length."""
        known = UnitRelativePose.of(invert(T_previous_current))
        return None if known is None else cls(*known, depth_previous, intrinsics)

    def warp_back(self, current: Grey) -> Grey:
        """The later image ``(H, W)`` warped to the earlier one, equal to it where the prediction is right."""
        return cv2.remap(
            current, self._current, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )

    def in_current(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Where pixels ``(M, 2)`` of the warped image lie in the later one."""
        if len(pixels) == 0:
            return pixels
        u, v = np.ascontiguousarray(pixels.T)
        moved = cv2.remap(self._current, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(moved, dtype=np.float32).reshape(-1, 2)

    def depth_current(self) -> DepthMap:
        """Z-depth ``(H, W)`` of the later image, of the surfaces that the earlier one shows; NaN where unknown.

        Of large images it is computed at about the size at which networks see them.
        """
        height, width = self.depth_previous.shape
        ratio = width // _DEPTH_WIDTH_PX
        if ratio > 1:
            size = width // ratio, max(height // ratio, 1)
            depth = cv2.resize(self.depth_previous, size, interpolation=cv2.INTER_NEAREST_EXACT)
            small = PredictedFlow(
                self.unit_pose, self.length, np.asarray(depth), self.intrinsics.resized(*size)
            )
            later = small.depth_current()
            return np.asarray(
                cv2.resize(later, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
            )
        grid = _pixels(self.intrinsics)
        flow = self._current - grid
        before = grid - flow
        for _ in range(_INVERSIONS - 1):  # fixed point: a pixel less the flow that ends there
            before = grid - cv2.remap(
                flow, before, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
        turned, moved = self._projection
        x, y = before[..., 0], before[..., 1]
        depth = cv2.remap(
            self.depth_previous, before, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
        )
        later = depth * (turned[2, 0] * x + turned[2, 1] * y + turned[2, 2]) + moved[2]
        return np.where((depth > 0) & (later > 0), later, np.float32(np.nan))

    @cached_property
    def _projection(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """``K R K^-1`` ``(3, 3)`` and ``K t`` ``(3,)``."""
        K = self.intrinsics.K
        turned = K @ self.unit_pose.R_current_previous @ np.linalg.inv(K)
        return turned.astype(np.float32), (self.length * K @ self.unit_pose.direction).astype(
            np.float32
        )

    @cached_property
    def _current(self) -> NDArray[np.float32]:
        """Pixels of the later image ``(H, W, 2)`` by those of the earlier one: ``K R K^-1 x + K t / z``."""
        height, width = self.depth_previous.shape
        turned, moved = self._projection
        rows, columns = max(height // _GRID_PX, 1), max(width // _GRID_PX, 1)
        depth = cv2.resize(
            self.depth_previous, (columns, rows), interpolation=cv2.INTER_NEAREST_EXACT
        )
        v = ((np.arange(rows) + 0.5) * height / rows - 0.5).astype(np.float32)
        u = ((np.arange(columns) + 0.5) * width / columns - 0.5).astype(np.float32)
        near = cv2.divide(1.0, depth)
        near[~(depth > 0)] = 0.0
        x, y, z = (
            cv2.scaleAdd(near, float(shift), np.add.outer(row[1] * v + row[2], row[0] * u))
            for row, shift in zip(turned, moved, strict=True)
        )
        ahead = cv2.max(z, _NEAREST)
        flow = cv2.merge([cv2.divide(x, ahead) - u, cv2.divide(y, ahead) - v[:, None]])
        return cv2.resize(flow, (width, height)) + _pixels(self.intrinsics)


@lru_cache(maxsize=2)
def _pixels(intrinsics: Intrinsics) -> NDArray[np.float32]:
    """Each pixel's own column and row ``(H, W, 2)``."""
    return intrinsics.pixel_grid().astype(np.float32)
