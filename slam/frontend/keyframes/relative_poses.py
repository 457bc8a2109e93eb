"""Relative poses from maps of keyframes, keyframe to keyframe and to the frames after it, and the units of the maps.

The unit of a map is by learned depth, with its drift along the map, and by the floor: the height of a carried camera
above the floor is what all maps of a drive have in common.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import solveh_banded

from slam.frames import KEYFRAME_SOURCE, LOOP_SOURCE, Ends, Intrinsics, RelativePose
from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe, TrackIds
from slam.frontend.visual.two_view import CORNER_CORRELATION
from slam.geometry.multiview import MIN_POINTS, resect
from slam.geometry.robust import mad_sigma
from slam.geometry.se3 import FloatArray, invert

_LEAST_LENGTH = 1e-6
_RELATIVE_SIGMA = 0.02  # least translation sigma of a factor over the length of its step
_ROTATION_SIGMA_DEG = 0.1  # least rotation sigma of a factor, degrees
_LEAST_DEPTHS = 20
_SHARED = 10  # keyframes that share an error of learned depth
_SIGMA, _LEAST_SIGMA = (
    0.3,
    0.05,
)  # of the logarithm of the unit of an image's learned depth, where it is not measured
_SAMPLES, _ROUNDS = 1000, 3
_MOST_POINTS = 2000  # by which planes are compared
_LEAST_COSINE = 0.8  # between the plane's normal and down by the cameras, which are held upright
_THICKNESS = 0.04  # of the floor, over the camera's height
_LEAST_RATIO, _LEAST_POINTS = 0.04, 25  # points on the floor, over all, and in number
_MOST_BELOW = 0.5  # points below the floor over those on it: a table has the floor below it
_MOST_SPREAD = 0.15  # of the camera's height
_MOST_CONTRADICTION = np.log(1.4)  # between two units of a map: a table is half as high


@dataclass(frozen=True)
class KeyframePoses:
    """Relative ``poses`` and ``loops`` in the units of their maps.

    ``segments`` is the number of the map of every frame that has a pose in one, ``learned_units`` the unit of learned
    depth per unit of each map, by its number: of all maps alike, where they see one floor.
    """

    poses: Sequence[RelativePose] = ()
    segments: Mapping[int, int] = field(default_factory=dict)
    loops: Sequence[RelativePose] = ()
    learned_units: Mapping[int, float] = field(default_factory=dict)

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
        first, last = (self.component.get(frame) for frame in pose.ends)
        return first is not None and first == last

    @property
    def steps(self) -> set[Ends]:
        """Neighbouring frames that both lie in one connected component of maps."""
        return {
            (k, k + 1)
            for k, number in self.component.items()
            if self.component.get(k + 1) == number
        }

    def relates(self, first: int) -> bool:
        """Whether the frames before ``first`` and the frames from it on have poses in one map."""
        before = max((frame for frame in self.segments if frame < first), default=None)
        after = min((frame for frame in self.segments if frame >= first), default=None)
        return (
            before is not None
            and after is not None
            and self.segments[before] == self.segments[after]
        )

    def length(self, first: int, last: int) -> float | None:
        """The distance of two frames in the unit of learned depth; None where no map has both."""
        number = self.segments.get(first)
        if number is None or number != self.segments.get(last):
            return None
        apart = self.T_map_camera[last][:3, 3] - self.T_map_camera[first][:3, 3]
        return self.learned_units[number] * float(np.linalg.norm(apart))

    @cached_property
    def T_map_camera(self) -> dict[int, FloatArray]:
        """Poses of the frames in the first frame of their connected component of maps."""
        return chained(self.poses)


def keyframe_poses(
    maps: Sequence[LocalMap], intrinsics: Intrinsics, seed: int = 0, loops: Sequence[Ends] = ()
) -> KeyframePoses:
    """All relative poses of the maps of a drive; ``loops`` are keyframes of one map that see one place, by frames."""
    poses: list[RelativePose] = []
    closing: dict[Ends, RelativePose] = {}
    segments: dict[int, int] = {}
    turns: list[RelativePose] = []
    maps = [segment for segment in maps if segment.started]
    learned = [learned_unit(segment) for segment in maps]
    for number, segment in enumerate(maps):
        located = _segment_poses(segment, intrinsics, seed)
        poses += located
        segments |= dict.fromkeys((frame for pose in located for frame in pose.ends), number)
        turns += [turn.scaled(1.0 / learned[number]) for turn in segment.turns]
        closing |= _loop_poses(segment, loops, intrinsics, seed)
    outside = [
        turn
        for turn in turns
        if segments.get(turn.from_index, -1) != segments.get(turn.to_index, -2)
    ]
    _connect(segments, outside)
    poses += [turn for turn in outside if turn.from_index in segments]
    units = units_by_floor(maps, learned, seed)
    return KeyframePoses(poses, segments, [closing[ends] for ends in loops], dict(enumerate(units)))


def _connect(segments: dict[int, int], turns: Sequence[RelativePose]) -> None:
    """Give frames that turns lead to, from a map or back from one, the number of that map."""
    for ordered, known, new in ((turns[::-1], 1, 0), (turns, 0, 1)):
        for turn in ordered:
            if turn.ends[known] in segments:
                segments.setdefault(turn.ends[new], segments[turn.ends[known]])


def _segment_poses(segment: LocalMap, intrinsics: Intrinsics, seed: int) -> list[RelativePose]:
    keyframes = segment.keyframes
    place = {keyframe.index: k for k, keyframe in enumerate(keyframes)}
    poses: list[RelativePose] = []
    for before, after in pairwise(keyframes):
        seen = _seen_from(
            segment, after.track_ids, after.pixels, after.T_camera_world, intrinsics, seed
        )
        sigmas = None if seen is None else seen[1]
        poses.append(_relative(before, after.index, after.T_camera_world, sigmas))
    T_guess = keyframes[0].T_camera_world
    for frame in segment.frames:
        if frame.index in place:
            T_guess = keyframes[place[frame.index]].T_camera_world
            continue
        pixels = frame.pixels.astype(np.float64)
        guess = T_guess if frame.T_camera_world is None else frame.T_camera_world
        located = _seen_from(segment, frame.track_ids, pixels, guess, intrinsics, seed)
        if located is not None:
            T_guess, sigmas = located
            nearest = max((k for k in keyframes if k.index < frame.index), key=lambda k: k.index)
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
    length = float(np.linalg.norm(T_from_to[:3, 3]))
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


def learned_unit(local: LocalMap) -> float:
    """Learned depth over depth in the map, the median over all sightings by keyframes; 1 where there are few."""
    joined = np.concatenate([local.ratios(keyframe) for keyframe in local.keyframes])
    known = joined[joined > 0.0]
    return float(np.median(1.0 / known)) if len(known) >= _LEAST_DEPTHS else 1.0


def learned_units(local: LocalMap, carried: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Learned depth over depth in the map along it ``(K,)``, and over what each keyframe says of it ``(K,)``.

    The logarithm of the unit is a random walk with sigmas ``carried`` ``(K - 1,)`` from each keyframe to the next.
    """
    known = [ratios[ratios > 0.0] for ratios in map(local.ratios, local.keyframes)]
    own = np.array(
        [-float(np.median(np.log(r))) if len(r) >= _LEAST_DEPTHS else np.nan for r in known]
    )
    if not np.isfinite(own).any():
        return np.ones(len(own)), np.ones(len(own))
    # the scatter of the units of learned depth about that of the map, by keyframes that share no error
    apart = own[_SHARED:] - own[:-_SHARED]
    apart = apart[np.isfinite(apart)]
    usual = (
        float(np.clip(mad_sigma(apart) / np.sqrt(2.0), _LEAST_SIGMA, _SIGMA))
        if len(apart) >= _SHARED
        else _SIGMA
    )
    weight = np.where(np.isfinite(own), 0.5 / _SHARED / usual**2, 0.0)
    own = np.nan_to_num(own)
    system = np.zeros((2, len(own)))
    system[1] = weight
    system[0, 1:] = -(carried**-2.0)
    system[1, 1:] += carried**-2.0
    system[1, :-1] += carried**-2.0
    walk = np.asarray(solveh_banded(system[-len(own) :], weight * own))
    return np.exp(walk), np.exp(np.where(weight > 0.0, walk - own, 0.0))


def units_by_floor(
    maps: Sequence[LocalMap], learned_units: Sequence[float], seed: int = 0
) -> list[float]:
    """The units of maps, so that the camera has one height in all that see a floor; learned ones where it contradicts.

    ``learned_units`` are those of learned depth per unit of each map, ``seed`` is that of the planes drawn.
    """
    units, floors = list(learned_units), {}
    for row, local in enumerate(maps if len(maps) > 1 else ()):
        height = height_above_floor(local, seed)
        if height is not None:
            floors[row] = height
    if floors:
        logarithms = [np.log(height * units[row]) for row, height in floors.items()]
        common = float(np.exp(np.median(logarithms)))
        for row, height in floors.items():
            if abs(np.log(common / height / units[row])) < _MOST_CONTRADICTION:
                units[row] = common / height
    return units


def height_above_floor(local: LocalMap, seed: int = 0) -> float | None:
    """The median height of the keyframes above the plane below which nothing is; None where no such plane is seen."""
    T_map_camera = local.T_world_camera
    centres, down = T_map_camera[:, :3, 3], T_map_camera[:, :3, 1].mean(axis=0)
    seen = np.unique(np.concatenate([keyframe.track_ids for keyframe in local.keyframes]))
    points = local.points[seen[local.parallax(local.keyframes).settled[seen]]]
    if len(points) < _LEAST_POINTS:
        return None
    origin = np.median(centres, axis=0)
    points, centres = points - origin, centres - origin
    rng = np.random.default_rng(seed)
    points = rng.permutation(points)[:_MOST_POINTS]
    depth = points @ down
    low = points[depth >= np.median(depth[depth > 0])] if (depth > 0).any() else points
    corners = low[rng.integers(len(low), size=(_SAMPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals, first = normals[length > 0] / length[length > 0, None], corners[length > 0, 0]
    normals *= np.sign(normals @ down)[:, None]
    heights = np.sum(normals * first, axis=1)
    possible = (normals @ down > _LEAST_COSINE * np.linalg.norm(down)) & (heights > 0)
    if not possible.any():
        return None
    normals, heights = normals[possible], heights[possible]
    over = points @ normals.T / heights - 1.0
    on, below = (np.abs(over) < _THICKNESS).sum(axis=0), (over > _THICKNESS).sum(axis=0)
    best = int(np.argmax(on - below / _MOST_BELOW))
    normal, height = normals[best], float(heights[best])
    for _ in range(_ROUNDS):
        floor = points[np.abs(points @ normal / height - 1.0) < _THICKNESS]
        if len(floor) < max(_LEAST_POINTS, _LEAST_RATIO * len(points)):
            return None
        middle = floor.mean(axis=0)
        normal = np.linalg.svd(floor - middle, full_matrices=False)[2][2]
        normal *= np.sign(normal @ down)
        height = float(normal @ middle)
    below = (points @ normal > (1.0 + _THICKNESS) * height).sum()
    heights_above = height - centres @ normal
    usual = float(np.median(heights_above))
    is_level = (
        normal @ down > _LEAST_COSINE * np.linalg.norm(down)
        and np.std(heights_above) < _MOST_SPREAD * usual
    )
    return usual if is_level and below < _MOST_BELOW * len(floor) else None
