"""Maps of one drive joined: brought into one world, tracks of the same corner made one, all keyframes adjusted."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slam.frames import Intrinsics
from slam.frontend.keyframes.local_map import OUTLIER_PX, LocalMap, MapSegment, TrackedFrame, TrackedKeyframe, TrackIds
from slam.geometry.se3 import FloatArray, apply, invert

logger = logging.getLogger(__name__)

# outliers are taken out at these multiples of their limit, from a start that is still off by the drift
_OUTLIER_LIMITS = (4.0, 2.0, 1.0)
_LIMITS = 20, 1e-4  # iterations of an adjustment, and the relative fall of the cost at which it ends


# rows of an earlier and of a later keyframe, and of the corners of both that are one point (M, 2)
Shared = tuple[int, int, NDArray[np.intp]]


def join(
    segments: Sequence[MapSegment],
    T_world_camera: FloatArray,
    scales: FloatArray,
    shared: Sequence[Shared],
    intrinsics: Intrinsics,
) -> tuple[MapSegment, list[float]]:
    """One map of several, or of one with loops; the segments stay as they are.

    Args:
        segments: in time order, started.
        T_world_camera: of all their keyframes in one world ``(K, 4, 4)``.
        scales: units of that world per unit of each keyframe's own map ``(K,)``.
        shared: corners of keyframes.
        intrinsics: of all images.

    Returns:
        The map, and for each of ``shared`` the ratio of its corners that the adjustment left in one point.
    """
    ends = np.cumsum([len(segment.map.keyframes) for segment in segments])[:-1]
    parts = zip(segments, np.split(T_world_camera, ends), np.split(scales, ends), strict=True)
    united = _united([moved(*part) for part in parts])
    keyframes = united.map.keyframes
    tracks = _merged_tracks(keyframes, len(united.map.points), shared)
    joined = _renumbered(united, tracks)
    _adjust_all(joined.map, intrinsics)
    return joined, [_kept_ratio(*pair, keyframes, joined.map.keyframes, tracks) for pair in shared]


def moved(segment: MapSegment, T_world_camera: FloatArray, scales: FloatArray) -> MapSegment:
    """A map by new poses ``(K, 4, 4)`` and units ``(K,)`` of its keyframes.

    Points follow the first keyframe that sees them, frames the last keyframe before them.
    """
    before = segment.map
    points = np.full_like(before.points, np.nan)
    for keyframe, T, scale in reversed(list(zip(before.keyframes, T_world_camera, scales, strict=True))):
        points_camera = apply(keyframe.T_camera_world, before.points[keyframe.track_ids])
        points[keyframe.track_ids] = apply(T, scale * points_camera)
    T_camera_world = invert(T_world_camera)
    keyframes = [replace(k, T_camera_world=T) for k, T in zip(before.keyframes, T_camera_world, strict=True)]
    indices = np.array([keyframe.index for keyframe in keyframes])
    frames = []
    for frame in segment.frames:
        row = max(int(np.searchsorted(indices, frame.index, side="right")) - 1, 0)
        T_followed = None
        if frame.T_camera_world is not None:
            T_frame_keyframe = frame.T_camera_world @ invert(before.keyframes[row].T_camera_world)
            T_frame_keyframe[:3, 3] *= scales[row]
            T_followed = T_frame_keyframe @ T_camera_world[row]
        frames.append(replace(frame, T_camera_world=T_followed))
    return MapSegment(LocalMap(keyframes, points), frames, segment.started, segment.turns)


def _united(segments: Sequence[MapSegment]) -> MapSegment:
    """The maps in one, with tracks numbered one map after the other."""
    keyframes: list[TrackedKeyframe] = []
    frames: list[TrackedFrame] = []
    first = 0
    for segment in segments:
        keyframes += [replace(keyframe, track_ids=keyframe.track_ids + first) for keyframe in segment.map.keyframes]
        frames += [replace(frame, track_ids=frame.track_ids + first) for frame in segment.frames]
        first += len(segment.map.points)
    points = np.concatenate([segment.map.points for segment in segments])
    turns = [turn for segment in segments for turn in segment.turns]
    return MapSegment(LocalMap(keyframes, points), frames, True, turns)


def _merged_tracks(keyframes: Sequence[TrackedKeyframe], count: int, shared: Sequence[Shared]) -> TrackIds:
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


def _renumbered(segment: MapSegment, tracks: TrackIds) -> MapSegment:
    keyframes = []
    for keyframe in segment.map.keyframes:
        merged = tracks[keyframe.track_ids]
        keyframes.append(keyframe.with_corners(np.argsort(merged), merged))
    points = segment.map.points.copy()
    lonely = np.flatnonzero(np.isnan(points[tracks, 0]) & np.isfinite(points[:, 0]))
    points[tracks[lonely]] = points[lonely]
    frames = [replace(frame, track_ids=tracks[frame.track_ids]) for frame in segment.frames]
    return MapSegment(LocalMap(keyframes, points), frames, True, segment.turns)


def _adjust_all(local: LocalMap, intrinsics: Intrinsics) -> None:
    """Adjust all keyframes but the first, in rounds between which outliers are taken out."""
    everything = range(len(local.keyframes))
    for limit in _OUTLIER_LIMITS:
        sightings, track_ids = local.sightings(everything, np.isfinite(local.points[:, 0]), intrinsics)
        gone, _ = local.solve(everything, 1, sightings, track_ids, intrinsics, _LIMITS, limit * OUTLIER_PX)
        outliers = sum(map(len, gone))
        logger.info("all %d keyframes adjusted: %d sightings, %d outliers", len(everything), len(sightings), outliers)


def _kept_ratio(
    earlier: int,
    later: int,
    corners: NDArray[np.intp],
    before: Sequence[TrackedKeyframe],
    after: Sequence[TrackedKeyframe],
    tracks: TrackIds,
) -> float:
    seen = [
        np.isin(tracks[before[row].track_ids[rows]], after[row].track_ids)
        for row, rows in zip((earlier, later), corners.T, strict=True)
    ]
    return float(np.mean(seen[0] & seen[1]))
