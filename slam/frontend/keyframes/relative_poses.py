"""Relative poses from maps of keyframes: keyframe to keyframe, and to the frames after it.

The unit of a map is by learned depth and by the floor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from slam.frames import KEYFRAME_SOURCE, LOOP_SOURCE, Ends, Intrinsics, RelativePose
from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe, TrackIds
from slam.frontend.keyframes.units import learned_unit, units_by_floor
from slam.frontend.visual.two_view import CORNER_CORRELATION
from slam.geometry.multiview import MIN_POINTS, resect
from slam.geometry.se3 import FloatArray, invert, length_of

_LEAST_LENGTH = 1e-6
_RELATIVE_SIGMA = 0.02  # least translation sigma of a factor over the length of its step
_ROTATION_SIGMA_DEG = 0.1  # least rotation sigma of a factor, degrees


@dataclass(frozen=True)
class KeyframePoses:
    """Relative ``poses`` and ``loops`` in the unit of learned depth, of all maps alike where they see one floor.

    ``segments`` is the number of the map of every frame that has a pose in one.
    """

    poses: Sequence[RelativePose] = ()
    segments: Mapping[int, int] = field(default_factory=dict)
    loops: Sequence[RelativePose] = ()

    @cached_property
    def component(self) -> Mapping[int, int]:
        """The connected component of maps, joined by poses between them, of each frame that has a pose in a map."""
        component = {number: number for number in self.segments.values()}
        for pose in self.poses:
            one, other = (component.get(self.segments.get(frame, -1)) for frame in pose.ends)
            if one is not None and other is not None:
                component = {
                    number: one if joined == other else joined
                    for number, joined in component.items()
                }
        return {frame: component[number] for frame, number in self.segments.items()}

    def is_inside(self, pose: RelativePose) -> bool:
        """Whether both frames of a measurement lie in one connected component of maps."""
        return _have_one(self.component, *pose.ends)

    @property
    def steps(self) -> set[Ends]:
        """Neighbouring frames that both lie in one connected component of maps."""
        return {
            (k, k + 1)
            for k, number in self.component.items()
            if self.component.get(k + 1) == number
        }

    def across(self, first: int) -> float | None:
        """The distance of the last frame before ``first`` and the next one that have poses; None without one map."""
        before = max((frame for frame in self.segments if frame < first), default=-1)
        after = min((frame for frame in self.segments if frame >= first), default=-1)
        return self.length(before, after)

    def length(self, first: int, last: int) -> float | None:
        """The distance of two frames; None where no map has both."""
        if not _have_one(self.segments, first, last):
            return None
        apart = self.T_map_camera[last][:3, 3] - self.T_map_camera[first][:3, 3]
        return length_of(apart)

    @cached_property
    def T_map_camera(self) -> dict[int, FloatArray]:
        """Poses of the frames in the first frame of their connected component of maps."""
        return chained(self.poses)


NO_MAPS = KeyframePoses()


def keyframe_poses(
    maps: Sequence[LocalMap], intrinsics: Intrinsics, seed: int = 0, loops: Sequence[Ends] = ()
) -> KeyframePoses:
    """All relative poses of the maps of a drive.

    Args:
        maps: in time order; those without points give none.
        intrinsics: of all images.
        seed: of RANSAC.
        loops: frames of two keyframes of one map that see one place.
    """
    poses: list[RelativePose] = []
    closing: dict[Ends, RelativePose] = {}
    segments: dict[int, int] = {}
    turns: list[RelativePose] = []
    maps = [segment for segment in maps if segment.started]
    learned = [learned_unit(segment) for segment in maps]
    units = units_by_floor(maps, learned, seed)
    for number, (segment, unit) in enumerate(zip(maps, units, strict=True)):
        located = _segment_poses(segment, intrinsics, seed)
        poses += [pose.scaled(unit) for pose in located]
        for pose in located:
            segments[pose.from_index] = segments[pose.to_index] = number
        turns += [turn.scaled(unit / learned[number]) for turn in segment.turns]
        for ends, loop in _loop_poses(segment, loops, intrinsics, seed).items():
            closing[ends] = loop.scaled(unit)
    outside = [turn for turn in turns if not _have_one(segments, *turn.ends)]
    _connect(segments, outside)
    poses += [turn for turn in outside if turn.from_index in segments]
    return KeyframePoses(poses, segments, [closing[ends] for ends in loops])


def _connect(segments: dict[int, int], turns: Sequence[RelativePose]) -> None:
    """Give frames that turns lead to, from a map or back from one, the number of that map."""
    for ordered, known, new in ((turns[::-1], 1, 0), (turns, 0, 1)):
        for turn in ordered:
            if turn.ends[known] in segments:
                segments.setdefault(turn.ends[new], segments[turn.ends[known]])


def _have_one(numbers: Mapping[int, int], first: int, last: int) -> bool:
    """Whether both frames have a number, and the same one."""
    return first in numbers and numbers[first] == numbers.get(last)


def _segment_poses(segment: LocalMap, intrinsics: Intrinsics, seed: int) -> list[RelativePose]:
    keyframes = segment.keyframes
    T_of = {keyframe.index: keyframe.T_camera_world for keyframe in keyframes}
    poses: list[RelativePose] = []
    for before, after in pairwise(keyframes):
        seen = _seen_from(
            segment, after.track_ids, after.pixels, after.T_camera_world, intrinsics, seed
        )
        sigmas = None if seen is None else seen[1]
        poses.append(_relative(before, after.index, after.T_camera_world, sigmas))
    T_guess = keyframes[0].T_camera_world
    for frame in segment.frames:
        if frame.index in T_of:
            T_guess = T_of[frame.index]
            continue
        pixels = frame.pixels.astype(np.float64)
        if frame.T_camera_keyframe is not None:
            T_guess = segment.T_camera_world(frame)
        located = _seen_from(segment, frame.track_ids, pixels, T_guess, intrinsics, seed)
        if located is not None:
            T_guess, sigmas = located
            nearest = keyframes[segment.row_before(frame.index)]
            poses.append(_relative(nearest, frame.index, T_guess, sigmas))
    return poses


def _loop_poses(
    local: LocalMap, loops: Sequence[Ends], intrinsics: Intrinsics, seed: int
) -> dict[Ends, RelativePose]:
    """Between keyframes of this map, their sigmas by the points that both see."""
    keyframes = {keyframe.index: keyframe for keyframe in local.keyframes}
    closing = {}
    for first, last in loops:
        if first not in keyframes or last not in keyframes:
            continue
        before, after = keyframes[first], keyframes[last]
        both = np.isin(after.track_ids, before.track_ids)
        T = after.T_camera_world
        seen = _seen_from(local, after.track_ids[both], after.pixels[both], T, intrinsics, seed)
        pose = _relative(before, last, T, None if seen is None else seen[1])
        closing[first, last] = replace(pose, source=LOOP_SOURCE)
    return closing


def _seen_from(
    local: LocalMap,
    track_ids: TrackIds,
    pixels: FloatArray,
    T_guess: FloatArray,
    intrinsics: Intrinsics,
    seed: int,
) -> tuple[FloatArray, FloatArray] | None:
    """``T_camera_world`` by the map's points and its sigmas ``(6,)``; None with too few inliers."""
    known = local.known(track_ids)
    if known.sum() < MIN_POINTS:
        return None
    pose = resect((T_guess,), local.points[track_ids[known]], pixels[known], intrinsics.K, seed)
    if len(pose.inliers) < MIN_POINTS or not np.isfinite(pose.sigmas).all():
        return None
    return pose.T_camera_world, CORNER_CORRELATION * pose.sigmas


def _relative(
    keyframe: TrackedKeyframe, index: int, T_camera_world: FloatArray, sigmas: FloatArray | None
) -> RelativePose:
    """From a keyframe to a later camera; with few points of its own, a keyframe has the least certain sigmas."""
    T_from_to = keyframe.T_camera_world @ invert(T_camera_world)
    length = length_of(T_from_to[:3, 3])
    floors = np.repeat(
        [np.deg2rad(_ROTATION_SIGMA_DEG), _RELATIVE_SIGMA * max(length, _LEAST_LENGTH)], 3
    )
    by_points = 10.0 * floors if sigmas is None else sigmas
    return RelativePose(
        keyframe.index, index, T_from_to, np.hypot(by_points, floors), KEYFRAME_SOURCE
    )


def chained(poses: Sequence[RelativePose]) -> dict[int, FloatArray]:
    """Poses of the frames of some maps in each map's first frame, from poses within them."""
    T_map_camera: dict[int, FloatArray] = {}
    for pose in sorted(poses, key=lambda pose: pose.to_index):
        T_map_from = T_map_camera.setdefault(pose.from_index, np.eye(4))
        T_map_camera[pose.to_index] = T_map_from @ pose.T_from_to
    return T_map_camera
