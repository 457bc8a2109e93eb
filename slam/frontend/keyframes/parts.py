"""A map in parts through each of which points carry one unit, and the motions between them.

A camera that turns on the spot sees new points with hardly any parallax. The map goes on with learned depth, whose unit
may be a tenth off, and every point fits. So it is cut there, and each part has the unit of learned depth or the floor.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from slam.frames import KEYFRAME_SOURCE, Intrinsics, RelativePose
from slam.frontend.keyframes.camera_pose import MIN_POINTS
from slam.frontend.keyframes.depth_prior import Parallax
from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe
from slam.frontend.keyframes.map_segment import MapSegment
from slam.frontend.keyframes.unit import learned_unit
from slam.geometry.se3 import FloatArray, invert

_PIXEL_SIGMA = 0.5  # of a sighting, pixels
_POINT_SIGMA = 0.005  # least relative sigma of the depth of a point
_INDEPENDENT = 10  # points with independent errors that those of a keyframe are worth: all share its pose
# sigmas of the logarithm of the unit: to the keyframe from which on points have parallax, and between two of one part
_BEGUN, _CARRIED = 0.03, 0.05
_LEAST_KEYFRAMES = 4  # of a part
_IMAGE_ROTATION, _IMAGE_LENGTH = np.deg2rad(0.5), 0.03  # sigmas of a turn of the whole image, radians and depths
_ROTATION, _LENGTH = np.deg2rad(0.1), 0.01  # least sigmas by points without parallax, radians and depths
_DEPTH_SIGMA = 0.2  # of a length by learned depth, over it


def parts_of(segment: MapSegment, intrinsics: Intrinsics) -> list[MapSegment]:
    """The parts of a map in time order; the map itself where no part has enough keyframes.

    Motions to keyframes and frames outside the parts, and to the next part, are ``turns`` of the part before, those
    before the first part its own.
    """
    local, keyframes = segment.map, segment.map.keyframes
    shared = np.array([len(np.intersect1d(a.track_ids, b.track_ids)) for a, b in pairwise(keyframes)])
    tied = shared >= MIN_POINTS
    number = np.concatenate([[0], np.cumsum(~(_carries(local, intrinsics) & tied))])
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
            parts[before[k - 1]].turns.append(_turn(local, keyframes[k - 1], *to_next, bool(tied[k - 1])))
    starts = np.array([keyframe.index for keyframe in keyframes])
    for frame in segment.frames:
        k = int(np.searchsorted(starts, frame.index, side="right")) - 1
        if part[k] >= 0:
            parts[part[k]].frames.append(frame)
        elif frame.T_camera_world is not None and frame.index != starts[k]:
            parts[before[k]].turns.append(_turn(local, keyframes[k], frame.index, frame.T_camera_world, True))
    for each in parts:
        each.turns.sort(key=lambda turn: turn.to_index)
    return parts


def _turn(
    local: LocalMap, keyframe: TrackedKeyframe, index: int, T_camera_world: FloatArray, is_tied: bool
) -> RelativePose:
    """From a keyframe to a later camera in the unit of learned depth, by points or else by the whole image."""
    T = keyframe.T_camera_world @ invert(T_camera_world)
    T[:3, 3] *= learned_unit(LocalMap([keyframe], local.points))
    learned = keyframe.learned_depth[np.isfinite(keyframe.learned_depth)]
    depth = float(np.median(learned)) if len(learned) else 1.0
    length = _LENGTH * depth + _DEPTH_SIGMA * float(np.linalg.norm(T[:3, 3]))
    sigmas = (_ROTATION, length) if is_tied else (_IMAGE_ROTATION, _IMAGE_LENGTH * depth)
    return RelativePose(keyframe.index, index, T, np.repeat(sigmas, 3), KEYFRAME_SOURCE)


def _carries(local: LocalMap, intrinsics: Intrinsics) -> NDArray[np.bool_]:
    """Whether points carry the unit from each keyframe to the next ``(K - 1,)``.

    A point carries it by its parallax between the first camera that saw it and those up to the earlier keyframe.
    """
    parallax = Parallax(local.points)
    pixel = _PIXEL_SIGMA / intrinsics.fx
    sigmas = []
    for keyframe in local.keyframes:
        tracks = keyframe.track_ids[local.known(keyframe.track_ids)]
        own = np.maximum(pixel / np.maximum(parallax.angle[tracks], 1e-6), _POINT_SIGMA)
        sigmas.append(1.0 / np.sqrt(max(_INDEPENDENT * float((own**-2.0).sum()) / max(len(tracks), 1), 1e-9)))
        parallax.see(keyframe.T_camera_world, tracks)
    found = np.array(sigmas[1:])
    begun = np.flatnonzero(found < _BEGUN)
    carries = found < _CARRIED
    carries[: begun[0] if len(begun) else None] = True
    return carries
