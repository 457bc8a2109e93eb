"""A map in parts through each of which points carry one unit, and the motions between them.

A camera that turns on the spot sees new points with hardly any parallax. The map goes on with learned depth, whose unit
may be a tenth off, and every point fits. So it is cut there, and each part has the unit of learned depth or the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from slam.frames import KEYFRAME_SOURCE, Intrinsics, RelativePose
from slam.frontend.keyframes.joining import moved
from slam.frontend.keyframes.local_map import LocalMap, MapSegment, Parallax, TrackedKeyframe
from slam.frontend.keyframes.unit import learned_units
from slam.geometry.resection import MIN_POINTS
from slam.geometry.se3 import FloatArray, chain, invert

_PIXEL_SIGMA = 0.5  # of a sighting, pixels
_POINT_SIGMA = 0.005  # least relative sigma of the depth of a point
_INDEPENDENT = 10  # points with independent errors that those of a keyframe are worth: all share its pose
# sigmas of the logarithm of the unit: to the keyframe from which on points have parallax, and between two of one part
_BEGUN, _CARRIED = 0.03, 0.05
_TURNED, _UNKNOWN = 0.05, 0.5  # the most by points without parallax, and where keyframes share few points
_DRIFT = 0.2  # of the sigma of one carry, that adds up along a map: what one keyframe lacks, the next ones see
_LEAST_KEYFRAMES = 4  # of a part
_IMAGE_ROTATION, _IMAGE_LENGTH = np.deg2rad(0.5), 0.03  # sigmas of a turn of the whole image, radians and depths
_ROTATION, _LENGTH = np.deg2rad(0.1), 0.01  # least sigmas by points without parallax, radians and depths
_DEPTH_SIGMA = 0.2  # of a length by learned depth, over it


def parts_of(segment: MapSegment, intrinsics: Intrinsics) -> list[MapSegment]:
    """The parts of a map in time order; the map itself where no part has enough keyframes.

    Motions to keyframes and frames outside the parts, and to the next part, are ``turns`` of the part before, those
    before the first part its own.
    """
    keyframes = segment.map.keyframes
    shared = np.array([len(np.intersect1d(a.track_ids, b.track_ids)) for a, b in pairwise(keyframes)])
    tied = shared >= MIN_POINTS
    sigmas = _sigmas(segment.map, intrinsics)
    along = np.minimum(sigmas, _TURNED) * np.where(sigmas < _CARRIED, _DRIFT, 1.0)
    segment = _held(segment, np.where(tied, along, _UNKNOWN))
    local, keyframes = segment.map, segment.map.keyframes
    begun, carries = np.flatnonzero(sigmas < _BEGUN), sigmas < _CARRIED
    carries[: begun[0] if len(begun) else None] = True  # before points have parallax
    number = np.concatenate([[0], np.cumsum(~(carries & tied))])
    pace = _pace([pair for pair, is_tied in zip(pairwise(keyframes), tied, strict=True) if is_tied])
    runs = [rows for n in range(number[-1] + 1) if len(rows := np.flatnonzero(number == n)) >= _LEAST_KEYFRAMES]
    if not runs:
        return [segment]
    parts = [MapSegment(LocalMap([keyframes[k] for k in rows], local.points), [], True) for rows in runs]
    part = np.full(len(keyframes), -1)
    for n, rows in enumerate(runs):
        part[rows] = n
    before = np.maximum.accumulate(part).clip(min=0)
    for k in range(1, len(keyframes)):
        if part[k] < 0 or part[k] != part[k - 1]:
            to_next = keyframes[k].index, keyframes[k].T_camera_world
            parts[before[k - 1]].turns.append(_turn(keyframes[k - 1], *to_next, None if tied[k - 1] else pace))
    starts = np.array([keyframe.index for keyframe in keyframes])
    for frame in segment.frames:
        k = int(np.searchsorted(starts, frame.index, side="right")) - 1
        if part[k] >= 0:
            parts[part[k]].frames.append(frame)
        elif frame.T_camera_world is not None and frame.index != starts[k]:
            parts[before[k]].turns.append(_turn(keyframes[k], frame.index, frame.T_camera_world))
    for piece in parts:
        piece.turns.sort(key=lambda turn: turn.to_index)
    return parts


def _held(segment: MapSegment, carried: FloatArray) -> MapSegment:
    """The map in the unit of learned depth, which holds its unit in the long run, and learned depth in the map's."""
    units, corrections = learned_units(segment.map, carried)
    T = segment.map.T_world_camera
    steps = invert(T[:-1]) @ T[1:]
    steps[:, :3, 3] *= np.sqrt(units[:-1] * units[1:])[:, None]
    held = moved(segment, chain(steps), units)
    pairs = zip(held.map.keyframes, corrections, strict=True)
    held.map.keyframes = [replace(k, learned_depth=correction * k.learned_depth) for k, correction in pairs]
    return held


def _pace(pairs: Sequence[tuple[TrackedKeyframe, TrackedKeyframe]]) -> float:
    """The median way of the camera from frame to frame between keyframes; 0 without any."""
    steps = [(a.T_camera_world @ invert(b.T_camera_world), b.index - a.index) for a, b in pairs]
    return float(np.median([np.linalg.norm(T[:3, 3]) / frames for T, frames in steps])) if steps else 0.0


def _turn(keyframe: TrackedKeyframe, index: int, T_camera_world: FloatArray, pace: float | None = None) -> RelativePose:
    """From a keyframe to a later camera in the unit of learned depth.

    Where no points lead there, but the whole image, it is a turn of unknown small length, whatever later adjustments
    made of it: at most some way at the camera's ``pace`` by frame.
    """
    T = keyframe.T_camera_world @ invert(T_camera_world)
    learned = keyframe.learned_depth[np.isfinite(keyframe.learned_depth)]
    depth = float(np.median(learned)) if len(learned) else 1.0
    if pace is None:
        sigmas = _ROTATION, _LENGTH * depth + _DEPTH_SIGMA * float(np.linalg.norm(T[:3, 3]))
    else:
        T[:3, 3] = 0.0
        sigmas = _IMAGE_ROTATION, _IMAGE_LENGTH * depth + pace * (index - keyframe.index)
    return RelativePose(keyframe.index, index, T, np.repeat(sigmas, 3), KEYFRAME_SOURCE)


def _sigmas(local: LocalMap, intrinsics: Intrinsics) -> FloatArray:
    """Sigmas of the logarithm of the unit as points carry it from each keyframe to the next ``(K - 1,)``.

    A point carries it by its parallax between the first camera that saw it and those up to the earlier keyframe.
    """
    parallax = Parallax(local.points)
    pixel = _PIXEL_SIGMA / intrinsics.fx
    sigmas = []
    for keyframe in local.keyframes:
        tracks = keyframe.track_ids[local.known(keyframe.track_ids)]
        depth_sigmas = np.maximum(pixel / np.maximum(parallax.angle[tracks], 1e-6), _POINT_SIGMA)
        sigmas.append(1.0 / np.sqrt(max(_INDEPENDENT * float((depth_sigmas**-2.0).sum()) / max(len(tracks), 1), 1e-9)))
        parallax.see(keyframe.T_camera_world, tracks)
    return np.array(sigmas[1:])
