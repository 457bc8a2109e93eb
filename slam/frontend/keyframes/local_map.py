"""Keyframes and the points they see: points from learned depth, found again, adjusted with the last keyframes.

Learned depth says what depths of an image are to each other, nothing about the unit of the map:
depths of one image fit each other much better than those of two images, for they share an unknown
unit. What remains is still no independent error of each point, so that it weighs less where rays
know a depth as well.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import DepthMap, Descriptors, Grey, Intrinsics, RelativePose, View, nearest_depth
from slam.frontend.keyframes.bundle_adjustment import BundleAdjustment, Sightings
from slam.frontend.keyframes.image_turn import turned
from slam.frontend.tracking import KEYFRAME_SEARCH, Pixels, are_inside, track
from slam.geometry.multiview import PIXEL_SIGMA
from slam.geometry.robust import median, weighted_median
from slam.geometry.se3 import FloatArray, apply, compose, invert

TrackIds = NDArray[np.int64]

_IMAGES_KEPT = 20
_LOOKED_BACK = 20  # keyframes between which points of the newest one have parallax
_MATCHED = KEYFRAME_SEARCH._replace(levels=1)  # guesses are near
_BORDER_PX = 8
_LEAST_MATCHED = 8
_SHARED = 5
# a keyframe is near if its camera is within this of the median depth, and looks the same way up to
# this cosine
_NEAR_DEPTHS = 0.5
_NEAR_COSINE = 0.7
_ALIGNED_PX = 2.0
_PROJECTED_PX = 4.0
_ALIGNED_KEYFRAMES = 4
# of dense flow there and back, and by which that of corners may correct it
_RETURNED_PX, _REFINED_PX = 2.0, 3.0
_REPLICATED = cv2.BORDER_REPLICATE
# of an image with the one that dense flow makes of it: 0.85 and more of one scene, of another to 0.66
_LEAST_CORRELATION = 0.75
# a point that two keyframes do not find is hidden; after three keyframes that find hardly any, so
# are those that remain
_ATTEMPTS, _MISSES = 2, 3
_LEAST_FOUND = 0.02
# most iterations of a bundle adjustment, and the relative fall of the cost at which it ends: each
# keyframe is adjusted ten times; but in a young map, depth and motion change together at hardly any
# cost
_LIMITS, _YOUNG_LIMITS = (6, 3e-3), (12, 1e-3)
_YOUNG = 6  # keyframes of a young map
OUTLIER_PX = 5.0  # residual of a sighting that is taken out, pixels
_ADJUSTED = 10  # number of the last keyframes that are adjusted
DEPTH_SIGMA = 0.3  # of the logarithm of learned depth
_SETTLED = np.deg2rad(1.0)  # angle between rays of a point with parallax
_LEAST_RATIOS = 20  # of known points to learned depth, by which new ones get their unit


class Parallax:
    """Of ``N`` points: the first ``centre`` that saw each ``(N, 3)``, NaN for none, and how well rays know them.

    Rays know a point by the widest angle between the first one and others.
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
    def settled(self) -> NDArray[np.bool_]:
        """Which points have parallax ``(N,)``."""
        return self._cosine < np.cos(_SETTLED)

    def by_rays(self, pixel_angle: float) -> FloatArray:
        """Sigmas of the logarithm of depth ``(N,)`` by rays that are known to ``pixel_angle`` radians."""
        angle = np.arccos(np.clip(self._cosine, -1.0, 1.0))
        return pixel_angle / np.maximum(angle, 1e-9)

    def prior_sigma(self, pixel_angle: float) -> FloatArray:
        """The same by learned depth ``(N,)``: errors that points share do not pull at what rays know."""
        return DEPTH_SIGMA * (1.0 + (DEPTH_SIGMA / self.by_rays(pixel_angle)) ** 2)

    def spread(self, pixel_angle: float, rows: TrackIds) -> FloatArray:
        """One sigma of points of ``M`` rows along their first rays ``(M, 3)``; rays are known to so many radians."""
        sigma = np.minimum(self.by_rays(pixel_angle)[rows], DEPTH_SIGMA)
        return sigma[:, None] * (self._points[rows] - self.centre[rows])


@dataclass(frozen=True)
class TrackedKeyframe:
    """A frame whose corners are sightings: ``track_ids`` ``(M,)`` in order and their ``pixels`` ``(M, 2)``.

    ``places`` ``(M, 2)`` are where its image has them: with a rolling shutter, pixels are as of the
    middle row. ``learned_depth`` ``(M,)`` is positive, NaN where unknown, ``descriptors`` are
    ``(M, 32)``; ``grey`` is None once the image is not kept any more. After a turn on the spot
    (``is_turn``) corners hardly say where the camera is.
    """

    index: int
    T_camera_world: FloatArray
    track_ids: TrackIds
    pixels: FloatArray
    places: FloatArray
    learned_depth: FloatArray
    descriptors: Descriptors
    grey: Grey | None
    is_turn: bool = False

    def with_depth(self, depth: DepthMap) -> TrackedKeyframe:
        """The same with learned depth ``(H, W)`` at its corners."""
        return replace(self, learned_depth=nearest_depth(depth, self.places))

    def without(self, gone: TrackIds) -> TrackedKeyframe:
        """The same without some tracks."""
        return self.with_corners(np.flatnonzero(~np.isin(self.track_ids, gone)), self.track_ids)

    def with_corners(self, rows: NDArray[np.intp], track_ids: TrackIds) -> TrackedKeyframe:
        """The same with some of its corners, whose tracks are rows of other ``track_ids`` ``(M,)``, in their order."""
        return replace(
            self,
            track_ids=track_ids[rows],
            pixels=self.pixels[rows],
            places=self.places[rows],
            learned_depth=self.learned_depth[rows],
            descriptors=self.descriptors[rows],
        )


@dataclass
class LocalMap:
    """One map, from its first keyframe to a loss; ``started`` once it has points.

    ``keyframes`` and ``frames`` are in time order, ``points`` ``(N, 3)`` in the world by track, NaN
    where unknown. ``turns`` are motions of the camera where no point carries the unit, in the unit
    of learned depth.
    """

    keyframes: list[TrackedKeyframe] = field(default_factory=list)
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    frames: list[TrackedFrame] = field(default_factory=list)
    started: bool = False
    turns: list[RelativePose] = field(default_factory=list)

    def copy(self) -> LocalMap:
        """A snapshot, which stays while this map grows."""
        keyframes, frames = self.keyframes.copy(), self.frames.copy()
        return LocalMap(keyframes, self.points.copy(), frames, self.started, self.turns.copy())

    @property
    def T_world_camera(self) -> FloatArray:
        """Poses of the keyframes ``(K, 4, 4)``."""
        return invert(
            np.array([keyframe.T_camera_world for keyframe in self.keyframes]).reshape(-1, 4, 4)
        )

    def row_before(self, index: int) -> int:
        """The row of the last keyframe up to a frame."""
        return bisect_right(self.keyframes, index, key=lambda keyframe: keyframe.index) - 1

    def T_camera_world(self, frame: TrackedFrame) -> FloatArray:
        """The pose of a frame that was located, wherever adjustments moved its keyframe."""
        assert frame.T_camera_keyframe is not None
        keyframe = self.keyframes[self.row_before(frame.index)]
        return compose(frame.T_camera_keyframe, keyframe.T_camera_world)

    def known(self, track_ids: TrackIds) -> NDArray[np.bool_]:
        """Which tracks have a point ``(M,)``."""
        return np.isfinite(self.points[track_ids, 0])

    def new_tracks(self, count: int) -> TrackIds:
        """Identifiers of new tracks."""
        first = len(self.points)
        self.points = np.vstack([self.points, np.full((count, 3), np.nan)])
        return np.arange(first, first + count)

    def add(self, keyframe: TrackedKeyframe) -> None:
        """Add the newest keyframe; images of old ones are not kept."""
        self.keyframes.append(keyframe)
        if len(self.keyframes) > _IMAGES_KEPT:
            self.keyframes[-_IMAGES_KEPT - 1] = replace(
                self.keyframes[-_IMAGES_KEPT - 1], grey=None
            )

    def views(self, points: FloatArray) -> list[View]:
        """Corners of all keyframes with their points in the camera, of ``points`` ``(N, 3)`` in the world by track."""
        views = []
        for keyframe in self.keyframes:
            seen = apply(keyframe.T_camera_world, points[keyframe.track_ids]).astype(np.float32)
            pixels = keyframe.pixels.astype(np.float32)
            views.append(View(keyframe.index, pixels, keyframe.descriptors, seen))
        return views

    def parallax(self, keyframes: Sequence[TrackedKeyframe]) -> Parallax:
        """Of all points, between those of the keyframes that see them."""
        parallax = Parallax(self.points)
        for keyframe in keyframes:
            parallax.see(
                keyframe.T_camera_world, keyframe.track_ids[self.known(keyframe.track_ids)]
            )
        return parallax

    def recent_parallax(self) -> Parallax:
        """Of all points between the last keyframes."""
        return self.parallax(self.keyframes[-_LOOKED_BACK:])

    def add_points(self, intrinsics: Intrinsics) -> Parallax:
        """Points of the newest keyframe's tracks that have none, at learned depth in the unit of the map.

        Returns:
            Parallax of all points between the last keyframes.
        """
        newest = self.keyframes[-1]
        tracks, learned = newest.track_ids, newest.learned_depth
        ratios = self.ratios(newest)
        both, new = ratios > 0.0, ~self.known(tracks) & (learned > 0.0)
        parallax = self.recent_parallax()
        by_rays = parallax.by_rays(PIXEL_SIGMA / intrinsics.fx)[tracks[both]]
        weights = 1.0 / (DEPTH_SIGMA**2 + by_rays**2)
        unit = weighted_median(ratios[both], weights) if both.sum() >= _LEAST_RATIOS else 1.0
        rays = intrinsics.rays(newest.pixels[new]) * (unit * learned[new, None])
        self.points[tracks[new]] = apply(invert(newest.T_camera_world), rays)
        parallax.see(newest.T_camera_world, tracks[new])
        return parallax

    def adjust(self, intrinsics: Intrinsics) -> TrackIds:
        """Adjust the last keyframes and their points; older ones that see many of these points stay fixed.

        Returns:
            Tracks whose point or newest sighting was taken out as an outlier.
        """
        first = max(len(self.keyframes) - _ADJUSTED, 0)
        seen = np.zeros(len(self.points), np.bool_)
        seen[np.concatenate([keyframe.track_ids for keyframe in self.keyframes[first:]])] = True
        seen &= np.isfinite(self.points[:, 0])
        # older keyframes that share most of these points
        shared = np.array([seen[keyframe.track_ids].sum() for keyframe in self.keyframes[:first]])
        most = np.argsort(shared, kind="stable")[::-1][:_ADJUSTED]
        fixed = np.sort(most[shared[most] >= _SHARED]).tolist()
        chosen = [*fixed, *range(first, len(self.keyframes))]
        limits = _YOUNG_LIMITS if len(self.keyframes) <= _YOUNG else _LIMITS
        gone, dead = self.solve(chosen, max(len(fixed), 1 + (first > 0)), seen, intrinsics, limits)
        return np.concatenate([dead, gone[-1]])

    def solve(
        self,
        chosen: Sequence[int],
        fixed: int,
        seen: NDArray[np.bool_],
        intrinsics: Intrinsics,
        limits: tuple[int, float],
        outlier_px: float = OUTLIER_PX,
    ) -> tuple[list[TrackIds], TrackIds]:
        """Adjust some keyframes and their points.

        Args:
            chosen: rows of the keyframes.
            fixed: how many of them stay, the first ones; turns on the spot stay, too.
            seen: the points that take part ``(N,)``, where two of these keyframes see them.
            intrinsics: of all images.
            limits: iterations, and the relative fall of the cost at which it ends.
            outlier_px: residual of a sighting that is taken out, pixels.

        Returns:
            Tracks whose sightings were taken out of each keyframe as outliers, and those that
            thereby lost their point.
        """
        sightings, track_ids = self.sightings(chosen, seen, intrinsics)
        free = np.array([not self.keyframes[k].is_turn for k in chosen])
        free[:fixed], free[-1] = False, True
        poses = np.array([self.keyframes[k].T_camera_world for k in chosen])
        problem = BundleAdjustment(sightings, intrinsics, free)
        solved = problem.solve(poses, self.points[track_ids], *limits)
        self.points[track_ids] = solved.points
        bad = solved.residual_px > outlier_px
        gone = [
            track_ids[sightings.point[bad & (sightings.camera == row)]]
            for row in range(len(chosen))
        ]
        for k, tracks, T in zip(chosen, gone, solved.T_camera_world, strict=True):
            self.keyframes[k] = replace(self.keyframes[k].without(tracks), T_camera_world=T)
        dead = track_ids[np.bincount(sightings.point[~bad], minlength=len(track_ids)) < 2]
        self.points[dead] = np.nan
        return gone, dead

    def sightings(
        self, chosen: Sequence[int], seen: NDArray[np.bool_], intrinsics: Intrinsics
    ) -> tuple[Sightings, TrackIds]:
        """Sightings of the points seen by at least two of the chosen keyframes, and the points' tracks."""
        keyframes = [self.keyframes[k] for k in chosen]
        track = np.concatenate([keyframe.track_ids for keyframe in keyframes])
        pixel = np.concatenate([keyframe.pixels for keyframe in keyframes])
        depth = np.concatenate([keyframe.learned_depth for keyframe in keyframes])
        camera = np.repeat(np.arange(len(chosen)), [len(each.track_ids) for each in keyframes])
        rows = np.flatnonzero(seen[track] & (np.bincount(track)[track] > 1))
        sigma = self.parallax(keyframes).prior_sigma(PIXEL_SIGMA / intrinsics.fx)[track[rows]]
        points, row_of = np.unique(track[rows], return_inverse=True)
        return Sightings(camera[rows], row_of, pixel[rows], depth[rows], sigma), points

    def ratios(self, keyframe: TrackedKeyframe) -> FloatArray:
        """Depth in the map over learned depth ``(M,)`` of a keyframe's corners, NaN where one is unknown."""
        depth = apply(keyframe.T_camera_world, self.points[keyframe.track_ids])[:, 2]
        return depth / keyframe.learned_depth

    def aligned(self, image: NewImage, track_ids: TrackIds, pixels: Pixels) -> Pixels:
        """Corners of a new keyframe aligned to the earliest of the last keyframes that sees them, against drift."""
        pixels, pending = pixels.copy(), np.ones(len(track_ids), np.bool_)
        for keyframe in self.keyframes[-_ALIGNED_KEYFRAMES:]:
            _, a, b = np.intersect1d(
                keyframe.track_ids, track_ids, assume_unique=True, return_indices=True
            )
            a, b = a[pending[b]], b[pending[b]]
            if len(a) < _LEAST_MATCHED:
                continue
            matched, kept = image.matched(keyframe, a, pixels[b])
            kept &= np.linalg.norm(matched - pixels[b], axis=1) < _ALIGNED_PX
            pixels[b[kept]] = matched[kept]
            pending[b[kept]] = False
        return pixels

    def found_again(self, image: NewImage, track_ids: TrackIds) -> tuple[TrackIds, Pixels]:
        """Known points that are not among the tracks of a new keyframe, found near their projections."""
        T_camera_world, intrinsics = image.T_camera_world, image.intrinsics
        attempts = np.where(np.isfinite(self.points[:, 0]), _ATTEMPTS, 0)
        attempts[track_ids] = 0
        tracks, places, misses = [], [], 0
        for keyframe in self._near(T_camera_world, track_ids):
            rows = np.flatnonzero(attempts[keyframe.track_ids])
            X = apply(T_camera_world, self.points[keyframe.track_ids[rows]])
            projected = intrinsics.project(X).astype(np.float32)
            limit = [intrinsics.width - _BORDER_PX, intrinsics.height - _BORDER_PX]
            inside = ((projected > _BORDER_PX) & (projected < limit)).all(axis=1)
            rows, projected = rows[inside], projected[inside]
            if len(rows) < _LEAST_MATCHED:
                continue
            matched, kept = image.matched(keyframe, rows, projected)
            kept &= np.linalg.norm(matched - projected, axis=1) < _PROJECTED_PX
            tracks.append(keyframe.track_ids[rows[kept]])
            places.append(matched[kept])
            attempts[keyframe.track_ids[rows]] -= 1
            attempts[tracks[-1]] = 0
            misses = misses + 1 if kept.sum() < _LEAST_FOUND * len(rows) else 0
            if misses == _MISSES:
                break
        if not tracks:
            return np.zeros(0, np.int64), np.zeros((0, 2), np.float32)
        return np.concatenate(tracks), np.concatenate(places)

    def _near(self, T_camera_world: FloatArray, track_ids: TrackIds) -> list[TrackedKeyframe]:
        """Keyframes with images whose cameras are near and look the same way, the nearest first."""
        known = track_ids[self.known(track_ids)]
        kept = [keyframe for keyframe in self.keyframes if keyframe.grey is not None]
        if not len(known) or not kept:
            return []
        depth = median(apply(T_camera_world, self.points[known])[:, 2])
        poses = np.array([keyframe.T_camera_world for keyframe in kept])
        centres = invert(poses)[:, :3, 3] - invert(T_camera_world)[:3, 3]
        distance = np.linalg.norm(centres, axis=1) / max(depth, 1e-9)
        cosine = poses[:, 2, :3] @ T_camera_world[2, :3]
        near = np.flatnonzero((distance < _NEAR_DEPTHS) & (cosine > _NEAR_COSINE))
        order = np.argsort((distance + 2.0 * (1.0 - cosine))[near], kind="stable")
        return [kept[k] for k in near[order]]


@dataclass(frozen=True)
class TrackedFrame:
    """Corners of a frame, ``track_ids`` ``(M,)`` and ``pixels`` ``(M, 2)``; its pose, None where it was lost.

    The pose is relative to the last keyframe up to it, for adjustments move both alike.
    """

    index: int
    track_ids: TrackIds
    pixels: Pixels
    T_camera_keyframe: FloatArray | None


class NewImage:
    """An image that becomes a keyframe, in which corners of earlier ones are found."""

    def __init__(self, grey: Grey, T_camera_world: FloatArray, intrinsics: Intrinsics) -> None:
        self._grey, self.T_camera_world, self.intrinsics = grey, T_camera_world, intrinsics
        self._turned: dict[int, Grey] = {}  # images of keyframes as the new camera is turned

    def matched(
        self, keyframe: TrackedKeyframe, rows: NDArray[np.intp], guesses: Pixels
    ) -> tuple[Pixels, NDArray[np.bool_]]:
        """Some corners of a keyframe from guesses ``(M, 2)``, and which were found ``(M,)``."""
        image, pixels = self._as_turned(keyframe)
        matched, kept = track(image, self._grey, pixels[rows], _MATCHED, guesses)
        return matched, kept & are_inside(matched, self._grey.shape)

    def flowed(self, keyframe: TrackedKeyframe) -> tuple[TrackIds, Pixels]:
        """Corners of a keyframe by dense optical flow, where steps are too large for that of corners."""
        image, pixels = self._as_turned(keyframe)
        flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        unknown = np.zeros((0, 0), np.float32)
        there = flow.calc(image, self._grey, unknown)
        back = flow.calc(self._grey, image, unknown)
        x, y = np.moveaxis((self.intrinsics.pixel_grid() + there).astype(np.float32), -1, 0)
        made = cv2.remap(self._grey, x, y, cv2.INTER_LINEAR, borderMode=_REPLICATED)
        is_seen = cv2.matchTemplate(made, image, cv2.TM_CCOEFF_NORMED) > _LEAST_CORRELATION
        rows = np.flatnonzero(are_inside(pixels, self._grey.shape) & is_seen[0])
        flowed = pixels[rows] + _at(there, pixels[rows])
        kept = are_inside(flowed, self._grey.shape)
        rows, flowed = rows[kept], flowed[kept]
        returned = flowed + _at(back, flowed)
        kept = np.linalg.norm(returned - pixels[rows], axis=1) < _RETURNED_PX
        rows, flowed = rows[kept], flowed[kept]
        matched, kept = self.matched(keyframe, rows, flowed)
        kept &= np.linalg.norm(matched - flowed, axis=1) < _REFINED_PX
        flowed[kept] = matched[kept]
        return keyframe.track_ids[rows], flowed

    def _as_turned(self, keyframe: TrackedKeyframe) -> tuple[Grey, Pixels]:
        """The image, which is kept, of a keyframe as the new camera is turned, and its corners ``(M, 2)`` there."""
        assert keyframe.grey is not None
        R, K = self.T_camera_world[:3, :3] @ keyframe.T_camera_world[:3, :3].T, self.intrinsics.K
        if keyframe.index not in self._turned:
            size = self.intrinsics.width, self.intrinsics.height
            H = K @ R @ np.linalg.inv(K)
            image = cv2.warpPerspective(keyframe.grey, H, size, borderMode=_REPLICATED)
            self._turned[keyframe.index] = np.asarray(image, np.uint8)
        return self._turned[keyframe.index], turned(keyframe.places, R, self.intrinsics)


def _at(flow: NDArray[np.float32], pixels: Pixels) -> Pixels:
    """Flow ``(H, W, 2)`` at the nearest pixels ``(M, 2)``, inside."""
    x, y = np.rint(pixels).astype(np.intp).T
    return flow[y, x]
