"""Camera poses by keyframes: corners are tracked from the last one, cameras are resected.

Corners are found again in each frame, and cameras are resected against the points of the map, as in
PTAM (Klein and Murray 2007) and ORB-SLAM (Mur-Artal et al. 2015), with optical flow in place
of descriptors. At 30 frames a second the parallax of neighbouring frames is a pixel; geometry over
longer baselines needs tracks that do not drift, so each corner is compared with its image in the
keyframe, not with that in the frame before. A lost camera is found again by `Relocaliser`, and the
first motion with parallax is that of `first_motion`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slam.frames import DepthMap, Event, Frame, Intrinsics, TrackingEvent, View
from slam.frontend.keyframes.first_motion import first_motion
from slam.frontend.keyframes.image_turn import (
    ImageTurn,
    SmallImage,
    image_shift,
    image_turn,
    in_middle_row,
    measured_turn,
    small_image,
    turned,
)
from slam.frontend.keyframes.local_map import (
    LocalMap,
    NewImage,
    Parallax,
    TrackedFrame,
    TrackedKeyframe,
    TrackIds,
)
from slam.frontend.keyframes.relocalisation import Relocaliser
from slam.frontend.tracking import KEYFRAME_SEARCH, Pixels, are_inside, new_corners, track
from slam.geometry.multiview import (
    INLIER_PX,
    MIN_POINTS,
    PIXEL_SIGMA,
    Resection,
    resect,
    rotation_between,
)
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray, apply, compose, invert, make
from slam.loops.features import describe

logger = logging.getLogger(__name__)

# a track this far from its projection has slipped
_SLIPPED = 8.0 / 3.0
_MOST_FLOW = 4.0
_LEAST_SHIFT_PX = 16.0  # smaller ones flow finds by itself
# of turned images, for a guess, for a measurement, and where they show a turn and hardly more
_LEAST_CORRELATION = 0.4
_SURE_CORRELATION = 0.82
_CLEAR_CORRELATION = 0.9
_KEYFRAME_TRACKS_RATIO = 0.25  # ratio of a keyframe's corners still tracked that asks for another
_FOUND_RATIO = 0.5  # of those in view, below which a turn asks for dense flow
# seconds without a pose after which a new map is begun, the next frame's included
_MAX_LOST_S = 0.35
_LAST_FRAMES = 4  # frames in which a pose is looked up
# median parallax that asks for a keyframe, over the image width; in a map of few keyframes
_PARALLAX_RATIO = 0.03
_YOUNG_PARALLAX_RATIO = 0.0125
_YOUNG_KEYFRAMES = 4
# keyframes between which points have parallax; without it a turn may go on, and a first motion be wrong
_LOOKED_BACK = 4
# from which on a first motion is doubted: a reversed one takes most of the flow for a turn
_DOUBTFUL_PARALLAX_RATIO = 0.005
_MAX_CORNERS = 500  # of a keyframe
# residual of half of the points where few have parallax, above which corners are sought by dense flow
_DOUBTFUL_PX = 0.5 * INLIER_PX
# of the median residual of corners without translation over that with it, where the latter is no
# noise: blurred corners always agree on some translation (on the spot mostly 0.4 to 1.3, of a walk
# 1.5 and more)
_TURN_RATIO, _NOISE_PX = 1.3, 0.5
# of the median residual at the place of a turn over that of a free pose, by dense flow, where the
# turn has ended (on the spot up to 1.7, of a walk soon 2 and more)
_END_RATIO = 1.7
_NOTHING: tuple[TrackIds, Pixels] = np.zeros(0, np.int64), np.zeros((0, 2), np.float32)


class KeyframeOdometry:
    """Poses of the frames of one sequence in the unit of each segment's map.

    ``segments`` are the maps so far, of which the last one grows with the frames; ``events`` tell
    what became of them.
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        seed: int = 0,
        on_keyframe: Callable[[Frame], None] = lambda frame: None,
        relocalises: bool = False,
    ) -> None:
        """Prepare for the first frame.

        Args:
            intrinsics: of all frames.
            seed: of RANSAC.
            on_keyframe: is told of a keyframe before it is adjusted, so that its depth is predicted
                meanwhile.
            relocalises: whether a lost camera is looked for among all keyframes of its map.
        """
        self._intrinsics = intrinsics
        self._seed = seed
        self._on_keyframe = on_keyframe
        self.segments: list[LocalMap] = []
        self._places: Pixels = np.zeros((0, 2), np.float32)  # of the keyframe's corners
        self._slipped: NDArray[np.bool_] = np.zeros(0, np.bool_)
        self._T_camera_world = self._T_last_step = np.eye(4)
        self._lost, self._stamp = 0, 0.0
        self._turn_rate = np.zeros(3)  # a second, where the shutter rolls
        self._small: SmallImage = np.zeros((0, 0), np.float32)
        self.events: list[TrackingEvent] = []
        # of the points of the last keyframe, once it is asked for
        self._known_parallax: Parallax | None = None
        self._settled: NDArray[np.bool_] | None = None  # points, by the last keyframes
        self._relocalises = relocalises
        self._relocaliser: Relocaliser | None = None  # of the lost map

    def follow(self, frame: Frame) -> None:
        """Track and resect the next usable frame; make it a keyframe where that is wanted.

        Where too few corners are tracked, the turn of the whole image leads to a keyframe of new
        corners. Depth of the last keyframe has been learned, if it has any.
        """
        self._follow(frame)
        started = [segment for segment in self.segments if segment.started]
        # until the camera is found again in the map in which it was lost, or another map has points
        if self._relocalises and started and (self._lost > 0 or not self.segments[-1].started):
            self._relocalise(started[-1], frame)
        else:
            self._relocaliser = None

    def _relocalise(self, lost: LocalMap, frame: Frame) -> None:
        """Look for the camera in the lost map; where it is found, the map goes on with this frame as a keyframe."""
        # one that begins may be lost at once
        if self._relocaliser is None or self._relocaliser.local is not lost:
            self._relocaliser = Relocaliser(lost, self._intrinsics, self._seed)
        corners = new_corners(frame, _NOTHING[1], _MAX_CORNERS)
        unknown = np.full((len(corners), 3), np.nan, np.float32)
        found = self._relocaliser.locate(
            View(frame.index, corners, describe(frame.grey, corners), unknown)
        )
        if found is None:
            return
        self._relocaliser = None  # the new keyframe changes the map
        T_camera_world, track_ids, pixels, place = found
        if self.segments[-1].started:
            self._note(self.segments[-1].frames[-self._lost].index, "lost")
            self.segments[-1].frames.pop()
        else:
            self.segments.pop()
        self._note(frame.index, "relocalised", place, len(track_ids))
        segment = self.segments[-1]
        self._T_camera_world, self._T_last_step, self._lost = T_camera_world, np.eye(4), 0
        self._add_keyframe(segment, frame, track_ids, pixels)
        self._keep(frame, track_ids, in_middle_row(pixels, self._turn_rate, self._intrinsics))

    def _follow(self, frame: Frame) -> None:
        before, self._small = self._small, small_image(frame.grey)
        shift = image_shift(before, self._small)
        images = before, self._small, self._T_last_step[:3, :3], shift, self._intrinsics
        turn = image_turn(*images) if np.hypot(*shift) > _LEAST_SHIFT_PX else None
        since, self._stamp = frame.stamp - self._stamp, frame.stamp
        # without learned depth there are no points
        if not self.segments or not self.segments[-1].started:
            del self.segments[-1:]
            self._begin(frame)
            return
        segment = self.segments[-1]
        track_ids, pixels = self._track(segment, frame, turn)
        if self._intrinsics.readout_s:  # how fast the camera turns, for a rolling shutter
            last = segment.frames[-1] if segment.frames else segment.keyframes[-1]
            _, a, b = np.intersect1d(
                last.track_ids, track_ids, assume_unique=True, return_indices=True
            )
            self._turn_rate = measured_turn(
                last.pixels[a], pixels[b], since, self._turn_rate, self._intrinsics
            )
        keyframe = segment.keyframes[-1]
        in_view = are_inside(self._places, frame.grey.shape).sum()
        are_few = len(track_ids) < _FOUND_RATIO * in_view
        # in a turn where most corners are lost, many that are found have slipped
        turns = are_few and turn is not None and turn.correlation > _CLEAR_CORRELATION
        if not turns and self._locate(segment, frame, track_ids, pixels):
            return
        turn = image_turn(*images) if turn is None else turn
        self._T_last_step = make(turn.R_now_before, np.zeros(3))
        T_turned = compose(self._T_last_step, self._T_camera_world)
        image = NewImage(frame.grey, T_turned, self._intrinsics)
        flowed_ids, flowed = image.flowed(keyframe)
        lost = ~np.isin(flowed_ids, track_ids) & ~frame.is_fixed(flowed)
        track_ids = np.concatenate([track_ids, flowed_ids[lost]])
        pixels = np.concatenate([pixels, flowed[lost]])
        is_located = turns and self._locate(segment, frame, track_ids, pixels)
        if is_located or self._locate(segment, frame, track_ids, pixels, is_doubtful=True):
            return
        if turn.correlation > _SURE_CORRELATION and not self._lost:
            self._T_camera_world = T_turned
            self._add_keyframe(segment, frame, *_NOTHING)
            self._keep(frame, *_NOTHING)
            return
        self._lost += 1
        segment.frames.append(TrackedFrame(frame.index, *_NOTHING, None))
        if (self._lost + 1) * since > _MAX_LOST_S:
            self._begin(frame)

    def learn(self, frame: Frame, depth: DepthMap) -> None:
        """Learned z-depth ``(H, W)`` of the frame that was followed last, which gives points where it is a keyframe."""
        segment = self.segments[-1]
        if segment.keyframes[-1].index != frame.index:
            return
        segment.keyframes[-1] = segment.keyframes[-1].with_depth(depth)
        self._known_parallax, self._settled = segment.add_points(self._intrinsics), None
        points = int(segment.known(segment.keyframes[-1].track_ids).sum())
        if not segment.started and points >= MIN_POINTS:
            segment.started = True
            for before in self.segments[:-1]:  # no keyframe will be added to them
                before.keyframes = [replace(keyframe, grey=None) for keyframe in before.keyframes]
            self._note(frame.index, "map begun", support=points)

    def locates(self, first: int, last: int) -> bool:
        """Whether two of the last frames both have a pose in the newest map."""
        frames = self.segments[-1].frames[-_LAST_FRAMES:] if self.segments else []
        located = {frame.index for frame in frames if frame.T_camera_keyframe is not None}
        return {first, last} <= located

    def _begin(self, frame: Frame) -> None:
        """A new map whose first keyframe is this frame."""
        if self._lost:
            self._note(self.segments[-1].frames[-self._lost].index, "lost")
        self.segments.append(LocalMap())
        self._T_camera_world, self._lost = np.eye(4), 0
        self._add_keyframe(self.segments[-1], frame, *_NOTHING)

    def _track(
        self, segment: LocalMap, frame: Frame, turn: ImageTurn | None
    ) -> tuple[TrackIds, Pixels]:
        """Corners of the last keyframe found in a frame; the others stay near their last places, moved by a turn."""
        keyframe = segment.keyframes[-1]
        rows = np.flatnonzero(~self._slipped)
        if keyframe.grey is None or not len(rows):
            return _NOTHING
        guesses = self._places[rows]
        if turn is not None and turn.correlation > _LEAST_CORRELATION:
            guesses = turned(guesses, turn.R_now_before, self._intrinsics)
        corners = keyframe.places[rows].astype(np.float32)
        tracked, kept = track(keyframe.grey, frame.grey, corners, KEYFRAME_SEARCH, guesses)
        kept &= are_inside(tracked, frame.grey.shape) & ~frame.is_fixed(tracked)
        shift = np.zeros(2, np.float32)
        if kept.any():
            shift = np.median(tracked[kept] - guesses[kept], axis=0)
        self._places[rows] = np.where(kept[:, None], tracked, guesses + shift)
        return keyframe.track_ids[rows[kept]], tracked[kept]

    def _locate(
        self,
        segment: LocalMap,
        frame: Frame,
        track_ids: TrackIds,
        pixels: Pixels,
        is_doubtful: bool = False,
    ) -> bool:
        """The camera's pose from known points; whether enough fit, most of them unless the frame ``is_doubtful``."""
        known = segment.known(track_ids)
        places, pixels = pixels, in_middle_row(pixels, self._turn_rate, self._intrinsics)
        tracked, last = (track_ids[known], pixels[known]), segment.keyframes[-1]
        if self._settled is None:
            self._settled = segment.parallax(segment.keyframes[-_LOOKED_BACK:]).settled
        is_settled = self._settled[track_ids].sum() >= MIN_POINTS
        is_still = not is_settled and (last.is_turn or is_doubtful)
        pose = self._resected(segment, *tracked, is_still)
        if pose and is_still and last.is_turn and is_doubtful:
            free = self._resected(segment, *tracked, False)
            if free and median(pose.residual_px) > _END_RATIO * median(free.residual_px):
                pose, is_still = free, False  # the turn has ended
        if pose is None:
            return False
        residual_px = median(pose.residual_px)
        fits = pose.residual_px < (INLIER_PX if is_settled else _DOUBTFUL_PX)
        if not is_doubtful and fits.mean() < 0.5:
            return False
        self._lost, T_before = 0, self._T_camera_world
        intrinsics = self._intrinsics
        slipped = track_ids[known][pose.residual_px > _SLIPPED * INLIER_PX]
        self._slipped |= np.isin(last.track_ids, slipped)
        kept = ~np.isin(track_ids, slipped)
        track_ids, places, pixels = track_ids[kept], places[kept], pixels[kept]
        first = last.pixels[np.searchsorted(last.track_ids, track_ids)]
        self._T_camera_world = pose.T_camera_world
        self._T_last_step = self._T_camera_world @ invert(T_before)
        R = self._T_camera_world[:3, :3] @ last.T_camera_world[:3, :3].T
        parallax = _apart(turned(first, R, intrinsics), pixels) / intrinsics.width
        flow = _apart(first, pixels) / intrinsics.width
        is_young = len(segment.keyframes) < _YOUNG_KEYFRAMES
        limit = _YOUNG_PARALLAX_RATIO if is_young else _PARALLAX_RATIO
        are_few = len(track_ids) < max(_KEYFRAME_TRACKS_RATIO * len(last.track_ids), MIN_POINTS)
        if are_few or parallax > limit or flow > _MOST_FLOW * limit:
            seen = pixels.astype(np.float64)
            is_turn = residual_px > _NOISE_PX and self._turns(first, seen, residual_px)
            if is_turn and not is_still:
                self._T_camera_world = T_before
                held = self._resected(segment, *tracked, True)
                is_turn = held is not None
                self._T_camera_world = (held or pose).T_camera_world
            moves = parallax > _DOUBTFUL_PARALLAX_RATIO
            if moves and not is_turn and (is_doubtful or not is_settled):
                self._check_first_motion(segment, track_ids, first, seen)
            self._add_keyframe(segment, frame, track_ids, places, is_turn)
        self._keep(frame, track_ids, pixels)
        return True

    def _turns(self, first: FloatArray, now: FloatArray, residual_px: float) -> bool:
        """Whether a turn moves corners ``first`` ``(M, 2)`` to where they are ``now``, hardly worse than the pose."""
        R = rotation_between(self._intrinsics.rays(first), self._intrinsics.rays(now))
        by_turn_px = _apart(turned(first, R, self._intrinsics), now)
        return by_turn_px < min(_TURN_RATIO * residual_px, INLIER_PX)

    def _keep(self, frame: Frame, track_ids: TrackIds, pixels: Pixels) -> None:
        """Keep a frame at the present pose, relative to the newest keyframe."""
        segment = self.segments[-1]
        T = compose(self._T_camera_world, invert(segment.keyframes[-1].T_camera_world))
        segment.frames.append(TrackedFrame(frame.index, track_ids, pixels, T))

    def _parallax(self, segment: LocalMap) -> Parallax:
        if self._known_parallax is None:
            self._known_parallax = segment.recent_parallax()
        return self._known_parallax

    def _resected(
        self, segment: LocalMap, track_ids: TrackIds, pixels: Pixels, is_still: bool
    ) -> Resection | None:
        """From the last and the predicted pose, at the last keyframe's place if ``is_still``; None with few inliers."""
        if len(track_ids) < MIN_POINTS:
            return None
        T_last = self._T_camera_world
        guesses = T_last, self._T_last_step @ T_last
        points = segment.points[track_ids]
        spread = self._parallax(segment).spread(PIXEL_SIGMA / self._intrinsics.fx, track_ids)
        before = np.isin(track_ids, [last.track_ids for last in segment.frames[-1:]])
        trusted = before if before.sum() >= MIN_POINTS else None
        pose = resect(
            guesses,
            points,
            pixels.astype(np.float64),
            self._intrinsics.K,
            self._seed,
            spread,
            trusted,
            invert(segment.keyframes[-1].T_camera_world)[:3, 3] if is_still else None,
        )
        return pose if len(pose.inliers) >= MIN_POINTS else None

    def _check_first_motion(
        self, segment: LocalMap, track_ids: TrackIds, first: FloatArray, now: FloatArray
    ) -> None:
        """The best motion since the last keyframe, from whose corners ``first`` ``(M, 2)`` moved, and its points."""
        before, known = segment.keyframes[-1], segment.known(track_ids)
        tracks, first, now = track_ids[known], first[known], now[known]
        depth = apply(before.T_camera_world, segment.points[tracks])[:, 2]
        T = self._T_camera_world @ invert(before.T_camera_world)
        T_now_before, depth = first_motion(T, first, now, depth, self._intrinsics, self._seed)
        self._T_camera_world = T_now_before @ before.T_camera_world
        points = self._intrinsics.rays(first) * depth[:, None]
        segment.points[tracks] = apply(invert(before.T_camera_world), points)

    def _add_keyframe(
        self,
        segment: LocalMap,
        frame: Frame,
        track_ids: TrackIds,
        pixels: Pixels,
        is_turn: bool = False,
    ) -> None:
        """Old corners aligned and found again, new ones between them, bundle adjustment after a translation."""
        self._on_keyframe(frame)
        intrinsics = self._intrinsics
        T, is_tracked = self._T_camera_world, len(track_ids) > 0
        if is_tracked:
            image = NewImage(frame.grey, T, intrinsics)
            pixels = segment.aligned(image, track_ids, pixels)
            again, reprojected = segment.found_again(image, track_ids)
            track_ids = np.concatenate([track_ids, again])
            pixels = np.concatenate([pixels, reprojected])
        fresh = new_corners(frame, pixels, _MAX_CORNERS - len(pixels))
        track_ids = np.concatenate([track_ids, segment.new_tracks(len(fresh))])
        pixels = np.concatenate([pixels, fresh])
        order = np.argsort(track_ids)
        track_ids, places = track_ids[order], pixels[order].astype(np.float64)
        unknown = np.full(len(track_ids), np.nan)
        middle = in_middle_row(places, self._turn_rate, intrinsics)
        descriptors = describe(frame.grey, places)
        keyframe = TrackedKeyframe(
            frame.index, T, track_ids, middle, places, unknown, descriptors, frame.grey, is_turn
        )
        segment.add(keyframe)
        if is_tracked and not is_turn:
            gone = segment.adjust(intrinsics)
            segment.keyframes[-1] = segment.keyframes[-1].without(gone)
            self._T_camera_world = segment.keyframes[-1].T_camera_world
        self._places = segment.keyframes[-1].places.astype(np.float32)
        self._slipped = np.zeros(len(self._places), np.bool_)
        self._known_parallax = self._settled = None

    def _note(
        self, frame: int, event: Event, other: int | None = None, support: int | None = None
    ) -> None:
        """Keep an event and log it."""
        self.events.append(TrackingEvent(frame, event, other, support))
        logger.info("%s", self.events[-1])


def _apart(first: Pixels | FloatArray, second: Pixels | FloatArray) -> float:
    """The median distance of pixels ``(M, 2)``."""
    return median(np.linalg.norm(first - second, axis=1))
