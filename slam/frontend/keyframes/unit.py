"""The unit of a map by learned depth, and along its keyframes where points carry it weakly.

A camera that turns on the spot sees new points with hardly any parallax. The map goes on in a unit that may be a tenth
off, and every point fits. Learned depth errs more in a single image, but alike before the turn and after it.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from slam.frames import KEYFRAME_SOURCE, Intrinsics, RelativePose
from slam.frontend.keyframes.camera_pose import MIN_POINTS
from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe
from slam.frontend.keyframes.map_segment import MapSegment
from slam.geometry.se3 import FloatArray, apply, invert

_LEAST_DEPTHS = 20
_PIXEL_SIGMA = 0.5  # of a sighting, pixels
_POINT_SIGMA = 0.005  # least relative sigma of the depth of a point
_INDEPENDENT = 10  # points with independent errors that those of a keyframe are worth: all share its pose
# sigmas of the logarithm of the unit: to the keyframe from which on points have parallax, and between two of one part
_BEGUN, _EXACT = 0.03, 0.05
_LEAST_KEYFRAMES = 4  # of a part
_IMAGE_SIGMA, _IMAGE_LENGTH = np.deg2rad(0.5), 0.03  # of a turn of the whole image, radians and depths
_ROTATION_SIGMA, _LENGTH_SIGMA = np.deg2rad(0.1), 0.01  # of a motion by points without parallax, radians and depths
_DEPTH_SIGMA = 0.2  # of a length by learned depth, over it


def learned_unit(local: LocalMap) -> float:
    """Learned depth over depth in the map, the median over all sightings by keyframes; 1 where there are few."""
    joined = np.concatenate([_ratios(local, keyframe) for keyframe in local.keyframes])
    return float(np.median(joined)) if len(joined) >= _LEAST_DEPTHS else 1.0


def pieces(segment: MapSegment, intrinsics: Intrinsics) -> list[MapSegment]:
    """The map in parts through each of which points carry one unit; what lies between them are turns."""
    local, keyframes = segment.map, segment.map.keyframes
    shared = np.array([np.isin(b.track_ids, a.track_ids).sum() for a, b in pairwise(keyframes)])
    strong = (_carried(local, intrinsics) < _EXACT**2) & (shared >= MIN_POINTS)
    part = np.concatenate([[0], np.cumsum(~strong)])
    runs = [rows for number in range(part[-1] + 1) if len(rows := np.flatnonzero(part == number)) >= _LEAST_KEYFRAMES]
    if not runs:
        return [segment]
    inside = np.full(len(keyframes), -1)
    for number, rows in enumerate(runs):
        inside[rows] = number
    starts = np.array([keyframe.index for keyframe in keyframes])
    found = [MapSegment(LocalMap([keyframes[k] for k in rows], local.points), [], True, []) for rows in runs]
    moves = [
        (k - 1, keyframe.index, keyframe.T_camera_world, bool(shared[k - 1] >= MIN_POINTS))
        for k, keyframe in enumerate(keyframes)
        if k and (inside[k] < 0 or inside[k] != inside[k - 1])
    ]
    for frame in segment.frames:
        k = int(np.searchsorted(starts, frame.index, side="right")) - 1
        if inside[k] >= 0:
            found[inside[k]].frames.append(frame)
        elif frame.T_camera_world is not None and frame.index not in starts:
            moves.append((k, frame.index, frame.T_camera_world, True))
    for k, index, T_camera_world, by_points in sorted(moves, key=lambda move: move[1]):
        number = max((inside[j] for j in range(k + 1) if inside[j] >= 0), default=0)
        found[number].turns.append(_turn(local, keyframes[k], index, T_camera_world, by_points))
    return found


def _turn(
    local: LocalMap, keyframe: TrackedKeyframe, index: int, T_camera_world: FloatArray, by_points: bool
) -> RelativePose:
    """From a keyframe to a later camera in the unit of learned depth."""
    T, ratios = keyframe.T_camera_world @ invert(T_camera_world), _ratios(local, keyframe)
    if len(ratios) >= _LEAST_DEPTHS:
        T[:3, 3] *= np.median(ratios)
    learned = keyframe.learned_depth[np.isfinite(keyframe.learned_depth)]
    depth = float(np.median(learned)) if len(learned) else 1.0
    if by_points:
        length = _LENGTH_SIGMA * depth + _DEPTH_SIGMA * float(np.linalg.norm(T[:3, 3]))
        sigmas = np.repeat([_ROTATION_SIGMA, length], 3)
    else:
        sigmas = np.repeat([_IMAGE_SIGMA, _IMAGE_LENGTH * depth], 3)
    return RelativePose(keyframe.index, index, T, sigmas, KEYFRAME_SOURCE)


def _carried(local: LocalMap, intrinsics: Intrinsics) -> FloatArray:
    """Variance of the logarithm of the unit from each keyframe to the next ``(K - 1,)``, by the points that carry it.

    A point carries it by its parallax between the first camera that saw it and those up to the earlier keyframe.
    """
    centre = np.full_like(local.points, np.nan)
    angle = np.zeros(len(local.points))
    pixel = _PIXEL_SIGMA / intrinsics.fx
    variance = []
    for keyframe in local.keyframes:
        tracks = keyframe.track_ids[local.known(keyframe.track_ids)]
        sigma = np.maximum(pixel / np.maximum(angle[tracks], 1e-6), _POINT_SIGMA)
        variance.append(1.0 / max(_INDEPENDENT * float((sigma**-2.0).sum()) / max(len(tracks), 1), 1e-9))
        camera = invert(keyframe.T_camera_world)[:3, 3]
        fresh = tracks[np.isnan(centre[tracks, 0])]
        centre[fresh] = camera
        first, now = local.points[tracks] - centre[tracks], local.points[tracks] - camera
        cosine = (first * now).sum(axis=1) / (np.linalg.norm(first, axis=1) * np.linalg.norm(now, axis=1))
        angle[tracks] = np.maximum(angle[tracks], np.arccos(np.clip(cosine, -1.0, 1.0)))
    carried = np.array(variance[1:])
    begun = np.flatnonzero(carried < _BEGUN**2)
    carried[: begun[0] if len(begun) else None] = _BEGUN**2 / 100
    return carried


def _ratios(local: LocalMap, keyframe: TrackedKeyframe) -> FloatArray:
    """Learned depth over depth in the map at the corners of a keyframe where both are known."""
    depth = apply(keyframe.T_camera_world, local.points[keyframe.track_ids])[:, 2]
    with np.errstate(invalid="ignore"):
        ratio = keyframe.learned_depth / depth
    return np.asarray(ratio[np.isfinite(ratio) & (ratio > 0)])
