"""The unit of a map by learned depth, and along its keyframes where points carry it weakly.

A camera that turns on the spot sees new points with hardly any parallax. The map goes on in a unit that may be a tenth
off, and every point fits. Learned depth errs more in a single image, but alike before the turn and after it.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded

from slam.frames import Intrinsics
from slam.frontend.keyframes.joining import moved
from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe
from slam.frontend.keyframes.map_segment import MapSegment
from slam.geometry.se3 import FloatArray, apply, invert

_LEAST_DEPTHS = 20
_PIXEL_SIGMA = 0.5  # of a sighting, pixels
_POINT_SIGMA = 0.005  # least relative sigma of the depth of a point
_INDEPENDENT = 10  # points with independent errors that those of a keyframe are worth: all share its pose
_LEARNED_SIGMA = 0.3  # of a keyframe's unit by learned depth, logarithm: its neighbours err alike
# sigmas of the logarithm of the unit: to the keyframe from which on points have parallax, and from the first keyframe
# to the last where learned depth is not needed
_BEGUN, _EXACT = 0.03, 0.1


def learned_unit(local: LocalMap) -> float:
    """Learned depth over depth in the map, the median over all sightings by keyframes; 1 where there are few."""
    joined = np.concatenate([_ratios(local, keyframe) for keyframe in local.keyframes])
    return float(np.median(joined)) if len(joined) >= _LEAST_DEPTHS else 1.0


def evened(segment: MapSegment, intrinsics: Intrinsics) -> MapSegment:
    """The map with one unit from its first keyframe to its last; itself where its points carry the unit."""
    local = segment.map
    variance = _carried(local, intrinsics)
    if len(variance) == 0 or np.sqrt(variance.sum()) < _EXACT:
        return segment
    ratios = [_ratios(local, keyframe) for keyframe in local.keyframes]
    known = np.array([len(each) >= _LEAST_DEPTHS for each in ratios])
    if not known.any():
        return segment
    measured = np.array([np.log(np.median(each)) if is_known else 0.0 for each, is_known in zip(ratios, known)])
    weight, link = known / _LEARNED_SIGMA**2, 1.0 / variance
    bands = np.zeros((2, len(ratios)))
    bands[0] = weight + np.append(link, 0.0) + np.append(0.0, link)
    bands[1, :-1] = -link
    unit = solveh_banded(bands, weight * measured, lower=True)
    scales = np.exp(unit - np.median(unit))
    T_world_camera = invert(np.array([keyframe.T_camera_world for keyframe in local.keyframes]))
    steps = scales[:-1, None] * np.diff(T_world_camera[:, :3, 3], axis=0)
    T_world_camera[1:, :3, 3] = T_world_camera[0, :3, 3] + np.cumsum(steps, axis=0)
    return moved(segment, T_world_camera, scales)


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
