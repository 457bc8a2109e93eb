"""Corners followed from image to image: Shi-Tomasi, pyramidal Lucas-Kanade, checked backwards.

Where the next image is foreseen, corners are followed twice, as they are and through their foreseen change of shape,
and go where their windows look more alike.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.config import GeometryConfig
from slam.frames import Frame, Image
from slam.frontend.visual.predicted_flow import Grey, Pixels, PredictedFlow
from slam.se3 import FloatArray
from slam.storage.cache import Answer, GetOrCompute, without_cache
from slam.storage.serialisation import Learner

_REMEMBERED = 4
# what is left to find is small where motion was foreseen
_FORESEEN_LEVELS = 2
_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01)


@dataclass(frozen=True)
class Tracks:
    """The same ``M`` scene points in two images, pixels ``(M, 2)`` each, and their names ``(M,)``.

    A corner keeps its name from frame to frame for as long as it can be followed.
    """

    previous: FloatArray
    current: FloatArray
    track_ids: NDArray[np.int64]


class CornerTracker(Learner):
    """Follows corners through one sequence: those that arrive in a frame stay, new ones fill the gaps."""

    remembers = ("_seen", "_next_track_id")

    def __init__(self, config: GeometryConfig, get_or_compute: GetOrCompute = without_cache) -> None:
        self._config = config
        self._get_or_compute = get_or_compute
        self._seen: OrderedDict[int, SeenImage] = OrderedDict()
        self._next_track_id = 0

    def track(self, previous: Frame, current: Frame, predicted_flow: PredictedFlow | None = None) -> Tracks:
        """Corners of ``previous`` found again in ``current``, with what is foreseen of it, if anything."""
        first, second = self._see(previous), self._see(current)
        if first.corners is None:
            self._fill(first, _no_corners())
        assert first.corners is not None
        forward, kept = self._found_again(first, second, first.corners.pixels, predicted_flow)
        track_ids = first.corners.track_ids[kept]
        if second.corners is None:
            self._fill(second, Corners(forward[kept], track_ids))
        return Tracks(first.corners.pixels[kept].astype(np.float64), forward[kept].astype(np.float64), track_ids)

    def ask_across(self, previous: Frame, current: Frame, predicted_flow: PredictedFlow) -> Callable[[], Tracks]:
        """How to find corners of ``previous`` that were followed to the next frame in a later one that is foreseen.

        What is returned finds them, in any thread.
        """
        first, second = self._see(previous), self._see(current)
        following = self._seen.get(previous.index + 1)
        if first.corners is None or following is None or following.corners is None:
            return lambda: Tracks(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int64))
        followed = np.isin(first.corners.track_ids, following.corners.track_ids)
        points, track_ids = first.corners.pixels[followed], first.corners.track_ids[followed]

        def follow() -> Answer:
            way = _through(second.grey, self._config.window_px, predicted_flow)
            found = self._followed(first.grey, second.grey, points, [way])
            return found.pixels, found.kept

        def find() -> Tracks:
            settings = repr((self._config.window_px, self._config.forward_backward_px))
            given = first.image, second.image, points, settings, *predicted_flow.given
            pixels, kept = self._get_or_compute("corners across a span", given, follow)
            return Tracks(points[kept].astype(np.float64), pixels[kept].astype(np.float64), track_ids[kept])

        return find

    def _found_again(
        self, first: SeenImage, second: SeenImage, points: Pixels, predicted_flow: PredictedFlow | None
    ) -> tuple[Pixels, NDArray[np.bool_]]:
        """Where points ``(M, 2)`` went and which can be believed, sought wider where they are few."""
        config = self._config

        def follow() -> Answer:
            found = self._follow(first.grey, second.grey, points, config.window_px, predicted_flow)
            if found.kept.sum() < config.few_corners:
                alike = _exposed_like(second.grey, first.grey)
                wider = self._follow(first.grey, alike, points, config.wide_window_px, predicted_flow)
                found = max(found, wider, key=lambda way: way.kept.sum())
            return found.pixels, found.kept

        settings = (
            config.window_px,
            config.wide_window_px,
            config.few_corners,
            config.pyramid_levels,
            config.forward_backward_px,
        )
        given = (
            first.image,
            second.image,
            points,
            repr(settings),
            *(() if predicted_flow is None else predicted_flow.given),
        )
        pixels, kept = self._get_or_compute("corners found again", given, follow)
        return pixels, kept

    def _see(self, frame: Frame) -> SeenImage:
        seen = self._seen.get(frame.index)
        if seen is None or seen.image is not frame.image:
            grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
            seen = self._seen[frame.index] = SeenImage(frame.image, grey)
        self._seen.move_to_end(frame.index)
        while len(self._seen) > _REMEMBERED:
            self._seen.popitem(last=False)
        return seen

    def _fill(self, seen: SeenImage, arrived: Corners) -> None:
        """Give a frame the corners that arrived and new ones where there is room."""
        config = self._config
        pixels, track_ids = arrived.pixels, arrived.track_ids
        room = config.max_corners - len(pixels)
        if room > 0:
            settings = (room, config.corner_quality, config.corner_spacing_px)
            (fresh,) = self._get_or_compute(
                "fresh corners", (seen.image, pixels, repr(settings)), lambda: (self._fresh(seen.grey, pixels, room),)
            )
            pixels = np.concatenate([pixels, fresh])
            track_ids = np.concatenate([track_ids, self._next_track_id + np.arange(len(fresh))])
            self._next_track_id += len(fresh)
        seen.corners = Corners(pixels, track_ids)

    def _fresh(self, grey: Grey, pixels: Pixels, room: int) -> Pixels:
        """At most ``room`` corners ``(M, 2)`` away from those known."""
        config = self._config
        free = _away_from(pixels, int(config.corner_spacing_px), grey.shape)
        corners = cv2.goodFeaturesToTrack(
            grey, room, config.corner_quality, config.corner_spacing_px, mask=free, blockSize=5
        )
        return np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)

    def _follow(
        self, first: Grey, second: Grey, points: Pixels, side: int, predicted_flow: PredictedFlow | None
    ) -> _Found:
        """Where points ``(M, 2)`` went, as they are or through what is foreseen, and which of them can be believed."""
        ways = [_Way(second, side, self._config.pyramid_levels)]
        if predicted_flow is not None:
            ways.append(_through(second, side, predicted_flow))
        return self._followed(first, second, points, ways)

    def _followed(self, first: Grey, second: Grey, points: Pixels, ways: Sequence[_Way]) -> _Found:
        """Points ``(M, 2)`` by the way that leaves windows most alike, of those that lead back."""
        pixels, kept = points.copy(), np.zeros(len(points), dtype=bool)
        if len(points) == 0:
            return _Found(pixels, kept)
        arrived = [_flow(first, way.image, points, way) for way in ways]
        unlike = np.stack([np.where(found, unlike, np.inf) for _, found, unlike in arrived])
        for choice in np.argsort(unlike, axis=0, kind="stable"):
            for n, (way, (forward, found, _)) in enumerate(zip(ways, arrived, strict=True)):
                tried = np.flatnonzero(~kept & (choice == n) & found)
                if len(tried) == 0:
                    continue
                backward, found_back, _ = _flow(way.image, first, forward[tried], way)
                error = np.abs(backward - points[tried]).max(axis=1)
                returned = tried[found_back & (error < self._config.forward_backward_px)]
                pixels[returned], kept[returned] = way.in_current(forward[returned]), True
        height, width = second.shape
        inside = (pixels >= 0).all(axis=1) & (pixels <= [width - 1, height - 1]).all(axis=1)
        return _Found(pixels, kept & inside)


@dataclass(frozen=True)
class _Way:
    """An image in which points are sought with windows of ``side`` over so many ``levels`` above it.

    ``in_current`` says where in the later image something of it lies.
    """

    image: Grey
    side: int
    levels: int
    in_current: Callable[[Pixels], Pixels] = lambda pixels: pixels


def _through(second: Grey, side: int, predicted_flow: PredictedFlow) -> _Way:
    """Through the later image with what is foreseen undone."""
    return _Way(predicted_flow.undone(second), side, _FORESEEN_LEVELS, predicted_flow.in_current)


def _flow(start: Grey, end: Grey, pixels: Pixels, way: _Way) -> tuple[Pixels, NDArray[np.bool_], NDArray[np.float32]]:
    """Where pixels ``(M, 2)`` went, which of them went anywhere, and how far their windows differ ``(M,)``."""
    moved, status, unlike = cv2.calcOpticalFlowPyrLK(
        start,
        end,
        pixels.reshape(-1, 1, 2),
        None,
        winSize=(way.side, way.side),
        maxLevel=way.levels,
        criteria=_CRITERIA,
    )
    return moved.reshape(-1, 2), status.ravel().astype(bool), unlike.ravel()


@dataclass(frozen=True)
class _Found:
    """Where points went ``(M, 2)``, and which of them can be believed ``(M,)``."""

    pixels: Pixels
    kept: NDArray[np.bool_]


@dataclass(frozen=True)
class Corners:
    """Corners of one image, pixels ``(M, 2)``, and their names ``(M,)``."""

    pixels: Pixels
    track_ids: NDArray[np.int64]


def _away_from(pixels: Pixels, radius: int, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """A mask ``(H, W)``, zero within ``radius`` of pixels ``(M, 2)`` inside of it, all of them drawn at once."""
    height, width = shape[0] + 2 * radius, shape[1] + 2 * radius
    disc = np.zeros((2 * radius + 1,) * 2, np.uint8)
    rows, columns = np.nonzero(cv2.circle(disc, (radius, radius), radius, 1, -1))
    u, v = np.rint(pixels).astype(np.int64).T
    mask = np.full(height * width, 255, np.uint8)
    mask[np.add.outer(v * width + u, rows * width + columns)] = 0
    return mask.reshape(height, width)[radius : height - radius, radius : width - radius]


def _exposed_like(grey: Grey, other: Grey) -> Grey:
    """An image ``(H, W)`` with the grey levels of another: each level takes that of the same rank."""
    ranks, ranks_other = (np.cumsum(np.bincount(image.ravel(), minlength=256)) / image.size for image in (grey, other))
    levels = np.interp(ranks, ranks_other, np.arange(256.0))
    return np.asarray(cv2.LUT(grey, np.rint(levels).astype(np.uint8)))


def _no_corners() -> Corners:
    return Corners(np.zeros((0, 2), np.float32), np.zeros(0, np.int64))


@dataclass
class SeenImage:
    """An image, its grey levels, and its corners once they are known."""

    image: Image
    grey: Grey
    corners: Corners | None = None
