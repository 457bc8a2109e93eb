"""Maps of keyframes cut into parts through each of which points carry one unit, and maps of one drive joined.

A camera that turns on the spot sees new points with hardly any parallax. The map goes on with
learned depth, whose unit may be a tenth off, and every point fits. So it is cut there, and each
part has the unit of learned depth or the floor.

Joined maps are brought into one world, tracks of the same corner made one, all keyframes adjusted.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from slam.frames import KEYFRAME_SOURCE, Intrinsics, RelativePose
from slam.frontend.keyframes.local_map import (
    OUTLIER_PX,
    LocalMap,
    Parallax,
    TrackedKeyframe,
    TrackIds,
)
from slam.frontend.keyframes.units import learned_units
from slam.geometry.multiview import MIN_POINTS
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray, apply, chain, compose, in_unit, invert, length_of

logger = logging.getLogger(__name__)

_PIXEL_SIGMA = 0.5  # of a sighting, pixels
_POINT_SIGMA = 0.005  # least relative sigma of the depth of a point
# points with independent errors that those of a keyframe are worth: all share its pose
_INDEPENDENT = 10
# sigmas of the logarithm of the unit
_BEGUN = 0.03  # to the keyframe from which on points have parallax
_CARRIED = 0.05  # between two keyframes of one part
_TURNED = 0.05  # the most by points without parallax, before points have any
_UNKNOWN = 2.0  # the most, and where keyframes share few points: learned depth alone says it
# of the sigma of one carry, that adds up along a map: what one keyframe lacks, the next ones see
_DRIFT = 0.2
_LEAST_KEYFRAMES = 4  # of a part
# sigmas of a turn of the whole image, radians and depths
_IMAGE_ROTATION = np.deg2rad(0.5)
_IMAGE_LENGTH = 0.03
# least sigmas by points without parallax, radians and depths
_ROTATION = np.deg2rad(0.1)
_LENGTH = 0.01
_DEPTH_SIGMA = 0.2  # of a length by learned depth, over it
# outliers are taken out at these multiples of their limit, from a start that is still off by the
# drift
_OUTLIER_LIMITS = (4.0, 2.0, 1.0)
# iterations of an adjustment, and the relative fall of the cost at which it ends
_LIMITS = (20, 1e-4)

# rows of an earlier and of a later keyframe, and of the corners of both that are one point (M, 2)
Shared = tuple[int, int, NDArray[np.intp]]


def parts_of(segment: LocalMap, intrinsics: Intrinsics) -> list[LocalMap]:
    """The parts of a map in time order; the map itself where no part has enough keyframes.

    Motions to keyframes and frames outside the parts, and to the next part, are ``turns`` of the
    part before, those before the first part its own.
    """
    neighbours = pairwise(segment.keyframes)
    shared = [len(np.intersect1d(a.track_ids, b.track_ids)) for a, b in neighbours]
    tied = np.array(shared) >= MIN_POINTS
    sigmas = _sigmas(segment, intrinsics)
    along = np.minimum(sigmas, _TURNED) * np.where(sigmas < _CARRIED, _DRIFT, 1.0)
    carried = tied & _carries(sigmas)
    over_cuts = np.where(tied, sigmas, np.inf).clip(max=_UNKNOWN)
    held = _held(segment, np.where(carried, along, over_cuts))
    part_of, parts = _cut(held, carried)
    if not parts:
        return [held]
    _add_turns(parts, part_of, held.keyframes, tied)
    _add_frames(parts, part_of, held)
    for part in parts:
        part.turns.sort(key=lambda turn: turn.to_index)
    return parts


def _carries(sigmas: FloatArray) -> NDArray[np.bool_]:
    """Whether points carry the unit from each keyframe to the next, by `_sigmas` ``(K - 1,)``."""
    begun = np.flatnonzero(sigmas < _BEGUN)
    carries = sigmas < _CARRIED
    carries[: begun[0] if len(begun) else None] = True  # before points have parallax
    return carries


def _cut(segment: LocalMap, carried: NDArray[np.bool_]) -> tuple[NDArray[np.intp], list[LocalMap]]:
    """The part of each keyframe ``(K,)``, -1 for none, and the parts with their keyframes alone.

    A part has enough keyframes from each of which the unit is ``carried`` ``(K - 1,)`` to the next.
    """
    run_of = np.concatenate([[0], np.cumsum(~carried)])
    part_of = np.full(len(run_of), -1)
    parts: list[LocalMap] = []
    for run in range(run_of[-1] + 1):
        rows = np.flatnonzero(run_of == run)
        if len(rows) >= _LEAST_KEYFRAMES:
            part_of[rows] = len(parts)
            keyframes = segment.keyframes[rows[0] : rows[-1] + 1]
            parts.append(LocalMap(keyframes, segment.points, [], True))
    return part_of, parts


def _add_turns(
    parts: Sequence[LocalMap],
    part_of: NDArray[np.intp],
    keyframes: Sequence[TrackedKeyframe],
    tied: NDArray[np.bool_],
) -> None:
    """Motions to keyframes outside the parts, and to the next part, as turns of the part before."""
    pace = _pace(keyframes, tied)
    before = _part_before(part_of)
    for k in range(1, len(keyframes)):
        if part_of[k] < 0 or part_of[k] != part_of[k - 1]:
            earlier, later = keyframes[k - 1], keyframes[k]
            by_image = None if tied[k - 1] else pace
            T = compose(earlier.T_camera_world, invert(later.T_camera_world))
            turn = _turn(earlier, later.index, T, by_image)
            parts[before[k - 1]].turns.append(turn)


def _add_frames(parts: Sequence[LocalMap], part_of: NDArray[np.intp], segment: LocalMap) -> None:
    """Frames of a map to its parts; those that were located outside are turns of the part before."""
    before = _part_before(part_of)
    for frame in segment.frames:
        k = segment.row_before(frame.index)
        keyframe = segment.keyframes[k]
        if part_of[k] >= 0:
            parts[part_of[k]].frames.append(frame)
        elif frame.T_camera_keyframe is not None and frame.index != keyframe.index:
            turn = _turn(keyframe, frame.index, invert(frame.T_camera_keyframe))
            parts[before[k]].turns.append(turn)


def _part_before(part_of: NDArray[np.intp]) -> NDArray[np.intp]:
    """The last part up to each keyframe ``(K,)``; the first one where there is none."""
    return np.maximum.accumulate(part_of).clip(min=0)


def _pace(keyframes: Sequence[TrackedKeyframe], tied: NDArray[np.bool_]) -> float:
    """The median way of the camera a frame between keyframes that points tie; 0 without any."""
    centres = invert(np.array([keyframe.T_camera_world for keyframe in keyframes]))[:, :3, 3]
    frames = np.diff([keyframe.index for keyframe in keyframes])
    paces = np.linalg.norm(np.diff(centres, axis=0), axis=1)[tied] / frames[tied]
    return median(paces) if len(paces) else 0.0


def _held(segment: LocalMap, carried: FloatArray) -> LocalMap:
    """The map in the unit of learned depth, which holds its unit in the long run, and learned depth in the map's."""
    units, corrections = learned_units(segment, carried)
    T = segment.T_world_camera
    steps = invert(T[:-1]) @ T[1:]
    steps[:, :3, 3] *= np.sqrt(units[:-1] * units[1:])[:, None]
    held = moved(segment, chain(steps), units)
    for row, correction in enumerate(corrections):
        keyframe = held.keyframes[row]
        learned = correction * keyframe.learned_depth
        held.keyframes[row] = replace(keyframe, learned_depth=learned)
    return held


def _turn(
    keyframe: TrackedKeyframe, index: int, T_keyframe_camera: FloatArray, pace: float | None = None
) -> RelativePose:
    """From a keyframe to a later camera in the unit of learned depth.

    Where no points lead there, but the whole image, it is a turn of unknown small length, whatever
    later adjustments made of it: at most some way at the camera's ``pace`` by frame.
    """
    T = T_keyframe_camera.copy()
    learned = keyframe.learned_depth[np.isfinite(keyframe.learned_depth)]
    depth = median(learned) if len(learned) else 1.0
    if pace is None:
        sigmas = _ROTATION, _LENGTH * depth + _DEPTH_SIGMA * length_of(T[:3, 3])
    else:
        T[:3, 3] = 0.0
        sigmas = _IMAGE_ROTATION, _IMAGE_LENGTH * depth + pace * (index - keyframe.index)
    return RelativePose(keyframe.index, index, T, np.repeat(sigmas, 3), KEYFRAME_SOURCE)


def _sigmas(local: LocalMap, intrinsics: Intrinsics) -> FloatArray:
    """Sigmas of the logarithm of the unit as points carry it from each keyframe to the next ``(K - 1,)``.

    A point carries it by its parallax between the first camera that saw it and those up to the
    earlier keyframe.
    """
    parallax = Parallax(local.points)
    pixel = _PIXEL_SIGMA / intrinsics.fx
    sigmas = []
    for keyframe in local.keyframes:
        tracks = keyframe.track_ids[local.known(keyframe.track_ids)]
        depth_sigmas = np.maximum(parallax.by_rays(pixel)[tracks], _POINT_SIGMA)
        weight = _INDEPENDENT * float((depth_sigmas**-2.0).sum()) / max(len(tracks), 1)
        sigmas.append(1.0 / np.sqrt(max(weight, 1e-9)))
        parallax.see(keyframe.T_camera_world, tracks)
    return np.array(sigmas[1:])


def join(
    segments: Sequence[LocalMap],
    T_world_camera: FloatArray,
    scales: FloatArray,
    shared: Sequence[Shared],
    intrinsics: Intrinsics,
) -> tuple[LocalMap, list[float]]:
    """One map of several, or of one with loops; the segments stay as they are.

    Args:
        segments: in time order, started.
        T_world_camera: of all their keyframes in one world ``(K, 4, 4)``.
        scales: units of that world per unit of each keyframe's own map ``(K,)``.
        shared: corners of keyframes.
        intrinsics: of all images.

    Returns:
        The map, and for each of ``shared`` the ratio of its corners that the adjustment left in one
        point.
    """
    ends = np.cumsum([len(segment.keyframes) for segment in segments])[:-1]
    parts = zip(segments, np.split(T_world_camera, ends), np.split(scales, ends), strict=True)
    united = _united([moved(*part) for part in parts])
    keyframes = united.keyframes
    tracks = _merged_tracks(keyframes, len(united.points), shared)
    joined = _renumbered(united, tracks)
    lonely = np.isnan(joined.points[tracks, 0]) & np.isfinite(joined.points[:, 0])
    joined.points[tracks[lonely]] = joined.points[lonely]
    everything = range(len(keyframes))
    for limit in _OUTLIER_LIMITS:
        seen = np.isfinite(joined.points[:, 0])
        gone, _ = joined.solve(everything, 1, seen, intrinsics, _LIMITS, limit * OUTLIER_PX)
        outliers = sum(map(len, gone))
        logger.info("all %d keyframes adjusted: %d outliers", len(everything), outliers)
    kept_ratios = []
    for earlier, later, corners in shared:
        kept = np.ones(len(corners), np.bool_)
        for row, rows in zip((earlier, later), corners.T, strict=True):
            of_corners = tracks[keyframes[row].track_ids[rows]]
            kept &= np.isin(of_corners, joined.keyframes[row].track_ids)
        kept_ratios.append(float(np.mean(kept)))
    return joined, kept_ratios


def moved(segment: LocalMap, T_world_camera: FloatArray, scales: FloatArray) -> LocalMap:
    """A map by new poses and units of its keyframes.

    Points follow the first keyframe that sees them, frames the last keyframe before them.

    Args:
        segment: stays as it is.
        T_world_camera: the new poses ``(K, 4, 4)``.
        scales: units of that world per unit of the map, at each keyframe ``(K,)``.
    """
    points = np.full_like(segment.points, np.nan)
    for keyframe, T, scale in reversed(
        list(zip(segment.keyframes, T_world_camera, scales, strict=True))
    ):
        points_camera = apply(keyframe.T_camera_world, segment.points[keyframe.track_ids])
        points[keyframe.track_ids] = apply(T, scale * points_camera)
    T_camera_world = invert(T_world_camera)
    keyframes = [
        replace(k, T_camera_world=T) for k, T in zip(segment.keyframes, T_camera_world, strict=True)
    ]
    frames = []
    for frame in segment.frames:
        T = frame.T_camera_keyframe
        if T is not None:
            T = in_unit(T, scales[segment.row_before(frame.index)])
        frames.append(replace(frame, T_camera_keyframe=T))
    return LocalMap(keyframes, points, frames, segment.started, segment.turns)


def _united(segments: Sequence[LocalMap]) -> LocalMap:
    """The maps in one, with tracks numbered one map after the other."""
    united = LocalMap(started=True)
    for segment in segments:
        numbered = _renumbered(segment, len(united.points) + np.arange(len(segment.points)))
        united.keyframes += numbered.keyframes
        united.frames += numbered.frames
        united.turns += numbered.turns
        united.points = np.concatenate([united.points, segment.points])
    return united


def _merged_tracks(
    keyframes: Sequence[TrackedKeyframe], count: int, shared: Sequence[Shared]
) -> TrackIds:
    """For each track the first one of the same point ``(count,)``; a keyframe never sees a point twice."""
    first = np.arange(count)
    members: dict[int, list[int]] = {}
    seen_by: dict[int, set[int]] = {}
    for row, keyframe in enumerate(keyframes):
        for track in keyframe.track_ids.tolist():
            seen_by.setdefault(track, set()).add(row)
    for earlier, later, corners in sorted(shared, key=lambda pair: -len(pair[2])):
        tracks_earlier = keyframes[earlier].track_ids[corners[:, 0]]
        tracks_later = keyframes[later].track_ids[corners[:, 1]]
        for a, b in zip(first[tracks_earlier].tolist(), tracks_later.tolist(), strict=True):
            one, other = sorted((int(first[a]), int(first[b])))
            if one == other or seen_by[one] & seen_by[other]:
                continue
            seen_by[one] |= seen_by[other]
            members.setdefault(one, [one]).extend(members.pop(other, [other]))
            first[members[one]] = one
    return first


def _renumbered(segment: LocalMap, tracks: TrackIds) -> LocalMap:
    """The map with other numbers of its tracks, whose points stay."""
    keyframes = []
    for keyframe in segment.keyframes:
        numbers = tracks[keyframe.track_ids]
        keyframes.append(keyframe.with_corners(np.argsort(numbers), numbers))
    frames = [replace(frame, track_ids=tracks[frame.track_ids]) for frame in segment.frames]
    return LocalMap(keyframes, segment.points, frames, True, segment.turns)
