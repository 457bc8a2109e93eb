"""Maps of keyframes closed after the last frame: loops among all keyframes, maps joined, all adjusted once."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from slam.frames import KEYFRAME_SOURCE, Ends, Intrinsics, RelativePose, TrackingEvent, View
from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe
from slam.frontend.keyframes.relative_poses import KeyframePoses, keyframe_poses
from slam.frontend.keyframes.submaps import join
from slam.frontend.scale import Scale
from slam.geometry.se3 import BoolArray, FloatArray, invert, length_of, make, path_distance
from slam.graph.pose_graph import optimise_similarities
from slam.loops.closure import LoopClosures, Track, find_loops, most_inliers_first
from slam.loops.verification import OF_KEYFRAMES, Loop, LoopVerifier

logger = logging.getLogger(__name__)

# keyframes that share so many tracks are in one place already
_CONNECTED = 10
_NEIGHBOURS = 3
# a loop is wrong if fewer of its corners are one point after the adjustment
_LEAST_KEPT = 0.5
# of neighbouring keyframes: rotation, translation over the step, logarithm of the scale
_ROTATION_SIGMA, _RELATIVE_SIGMA, _SCALE_SIGMA = 0.005, 0.03, 0.02
_LEAST_SIGMA = 1e-4
_UNRELATED = 1e9  # length by which odometry may err between maps that no motion relates
# of the logarithm of the ratio of two units by a loop, and by learned depth
_LOOP_SCALE_SIGMA, _LINK_SCALE_SIGMA = 0.05, 0.3


@dataclass(frozen=True)
class MapClosure:
    """Poses by the closed maps, the ``loops`` among their keyframes, and the maps that were joined.

    Lengths of loops are in the unit of their maps.
    """

    poses: KeyframePoses
    loops: LoopClosures = field(default_factory=LoopClosures)
    joins: tuple[TrackingEvent, ...] = ()

    def closures(self, scale: Scale) -> LoopClosures:
        """The loops in the unit of the scale, the accepted ones by the relative poses of the closed maps."""
        accepted = [
            replace(loop, measured=scale.scaled(pose))
            for pose, loop in zip(self.poses.loops, self.loops.accepted, strict=True)
        ]
        return replace(self.loops, accepted=tuple(accepted))


def close_maps(
    maps: Sequence[LocalMap], poses: KeyframePoses, intrinsics: Intrinsics, seed: int = 0
) -> MapClosure:
    """Find loops among all keyframes, join maps that share a place, adjust all keyframes of maps with loops.

    The ``maps`` of one drive, in time order, stay as they are, and so do their ``poses`` where no loop is found.
    """
    rows = _Rows(maps, poses)
    apart = rows.apart()
    closures = find_loops(
        rows.views(), rows.track, apart.__getitem__, LoopVerifier(OF_KEYFRAMES, intrinsics, seed)
    )
    while closures.accepted:
        loops = closures.accepted
        closed, wrong = _closed(rows, loops, intrinsics)
        if not wrong:
            poses = keyframe_poses(closed, intrinsics, seed, [loop.ends for loop in loops])
            break
        refused = [
            loop.refused("its corners are not the same points after the adjustment")
            for loop in wrong
        ]
        rejected = most_inliers_first([*closures.rejected, *refused])
        closures = replace(
            closures, accepted=tuple(loop for loop in loops if loop not in wrong), rejected=rejected
        )
    joins = rows.joins(closures.accepted)
    for joined in joins:
        logger.info("%s", joined)
    return MapClosure(poses, closures, joins)


class _Rows:
    """The keyframes of all maps, row by row."""

    def __init__(self, maps: Sequence[LocalMap], poses: KeyframePoses) -> None:
        self.segments = maps
        self.keyframes: list[TrackedKeyframe] = []
        for segment in maps:
            self.keyframes += segment.keyframes
        counts = [len(segment.keyframes) for segment in maps]
        self.maps: NDArray[np.intp] = np.repeat(np.arange(len(maps)), counts)
        self.T_map_camera = np.concatenate([segment.T_world_camera for segment in maps])
        # where odometry has the keyframes: parts of a map are related by the motions between them
        frames = np.array([keyframe.index for keyframe in self.keyframes], np.intp)
        T, worlds = [], []
        for k, number, own in zip(frames.tolist(), self.maps, self.T_map_camera, strict=True):
            T.append(poses.T_map_camera.get(k, own))
            worlds.append(poses.component.get(k, number))
        T_world_camera = np.array(T)
        path = path_distance(T_world_camera) + _UNRELATED * np.array(worlds)
        self.track = Track(T_world_camera, path, frames, self.maps)
        self._worlds, self._poses = worlds, poses.poses

    def links(self, loops: Sequence[Loop]) -> list[Loop]:
        """Motions from one map to the next where both have loops, which know better how far both are apart.

        The units of both are that of learned depth.
        """
        links, closed, T = [], self.maps[self.track.rows(loops)], self.track.T_world_camera
        for last in np.flatnonzero(np.diff(self.maps)).tolist():
            ends = slice(last, last + 2)
            if np.isin(self.maps[ends], closed).all() and len(set(self._worlds[ends])) == 1:
                first, final = self.track.frames[ends].tolist()
                between = [p for p in self._poses if first <= p.from_index and p.to_index <= final]
                sigmas = np.linalg.norm([pose.sigmas for pose in between], axis=0)
                T_last_next = invert(T[last]) @ T[last + 1]
                pose = RelativePose(first, final, T_last_next, sigmas, KEYFRAME_SOURCE)
                links.append(Loop(pose, 0, 0.0))
        return links

    def views(self) -> list[View]:
        """Corners with their points in the camera where these have parallax: others would give a loop a wrong scale."""
        views = []
        for segment in self.segments:
            settled = segment.parallax(segment.keyframes).settled[:, None]
            views += segment.views(np.where(settled, segment.points, np.nan))
        return views

    def apart(self) -> BoolArray:
        """Which keyframes share few tracks ``(K, K)``."""
        first = np.cumsum([0, *(len(segment.points) for segment in self.segments)])
        tracks = [
            k.track_ids + first[number] for k, number in zip(self.keyframes, self.maps, strict=True)
        ]
        of_row = np.repeat(np.arange(len(tracks)), [len(of_keyframe) for of_keyframe in tracks])
        shape = len(tracks), int(first[-1])
        seen = csr_array((np.ones(len(of_row)), (of_row, np.concatenate(tracks))), shape=shape)
        return (seen @ seen.T).toarray() < _CONNECTED

    def joins(self, loops: Sequence[Loop]) -> tuple[TrackingEvent, ...]:
        """Each map after the first that loops join with an earlier one."""
        events, pairs = [], self.maps[self.track.rows(loops)]
        for number, segment in enumerate(self.segments):
            joining = np.flatnonzero((pairs[:, 0] != number) & (pairs[:, 1] == number))
            if len(joining):
                first, other = segment.keyframes[0].index, loops[joining[0]].ends[0]
                events.append(TrackingEvent(first, "map joined", other, len(joining)))
        return tuple(events)


def _closed(
    rows: _Rows, loops: Sequence[Loop], intrinsics: Intrinsics
) -> tuple[list[LocalMap], list[Loop]]:
    """The maps after these loops, and the loops that the adjustment contradicts."""
    across, count = [*loops, *rows.links(loops)], len(rows.segments)
    one, other = rows.maps[rows.track.rows(across)].T
    joining = csr_array((np.ones(len(one)), (one, other)), shape=(count, count))
    _, group = connected_components(joining, directed=False)
    closed = []
    wrong: list[Loop] = []
    for number in np.unique(group):
        members = np.flatnonzero(group == number)
        inside = list(compress(across, group[one] == number))
        if not inside:
            closed += [rows.segments[member] for member in members]
            continue
        joined, kept = _joined(rows, inside, members, intrinsics)
        closed.append(joined)
        wrong += compress(inside, np.less(kept, _LEAST_KEPT))
    return closed, wrong


def _joined(
    rows: _Rows, loops: Sequence[Loop], members: NDArray[np.intp], intrinsics: Intrinsics
) -> tuple[LocalMap, list[float]]:
    """One map by loops and, after these, links; the ratio of each loop's corners that are still one point."""
    chosen = np.flatnonzero(np.isin(rows.maps, members))
    maps, T_map_camera = rows.maps[chosen], rows.T_map_camera[chosen]
    edges, shared = [], []
    # between neighbouring keyframes of one map, whose unit hardly changes
    for first in range(len(chosen)):
        for last in range(first + 1, min(first + 1 + _NEIGHBOURS, len(chosen))):
            if maps[first] == maps[last]:
                T_step = invert(T_map_camera[first]) @ T_map_camera[last]
                length = _RELATIVE_SIGMA * length_of(T_step[:3, 3]) + _LEAST_SIGMA
                sigmas = np.repeat([_ROTATION_SIGMA, length], 3)
                pose = RelativePose(first, last, T_step, sigmas, KEYFRAME_SOURCE)
                edges.append((pose, 1.0, _SCALE_SIGMA))
    places = np.searchsorted(chosen, rows.track.rows(loops)).tolist()
    for loop, (earlier, later) in zip(loops, places, strict=True):
        pose = replace(loop.measured, from_index=earlier, to_index=later)
        scale_sigma = _LOOP_SCALE_SIGMA if loop.inliers else _LINK_SCALE_SIGMA
        edges.append((pose, loop.scale, scale_sigma))
        if loop.inliers:
            shared.append((earlier, later, loop.corners))
    T, scales = optimise_similarities(*_start(len(chosen), edges), edges)
    return join([rows.segments[member] for member in members], T, scales, shared, intrinsics)


def _start(
    count: int, edges: Sequence[tuple[RelativePose, float, float]]
) -> tuple[FloatArray, FloatArray]:
    """Poses ``(K, 4, 4)`` and units ``(K,)`` of cameras in the first one, by the surest edges that lead there."""
    sigmas = np.zeros((count, count))
    steps: dict[Ends, NDArray[np.floating[Any]]] = {}
    for pose, scale, scale_sigma in edges:
        step = pose.T_from_to.copy()
        step[:3, :3] *= scale
        steps[pose.ends], steps[pose.ends[::-1]] = step, np.linalg.inv(step)
        sigmas[pose.ends] = scale_sigma + pose.sigmas[:3].sum()
    order, before = breadth_first_order(minimum_spanning_tree(sigmas), 0, directed=False)
    similar = np.tile(np.eye(4), (count, 1, 1))
    for row in order[1:].tolist():
        similar[row] = similar[before[row]] @ steps[int(before[row]), row]
    scales = np.cbrt(np.linalg.det(similar[:, :3, :3]))
    return make(similar[:, :3, :3] / scales[:, None, None], similar[:, :3, 3]), scales
