import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import room

from slam.frames import KEYFRAME_SOURCE, LOOP_SOURCE, RelativePose
from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe
from slam.frontend.keyframes.odometry import KeyframeOdometry
from slam.frontend.keyframes.relative_poses import keyframe_poses
from slam.geometry.se3 import FloatArray, apply, invert, make, rotation_angle
from slam.loops.closure import LoopClosures
from slam.loops.verification import Loop
from slam.pipeline import map_closure
from slam.pipeline.map_closure import MapClosure, close_maps
from slam.sequences.catalogue import open_sequence


@functools.cache
def lost_on_the_way() -> tuple[FloatArray, KeyframeOdometry]:
    """Two maps, and the true poses; on the way back the camera is rolled and closer."""
    walked = room.there_and_back(80, roll=0.4, closer=0.3)
    truth = np.concatenate([walked[:22], walked[35:]])
    return truth, room.tracked(truth, [0] * 22 + [9] * 7 + [0] * 38)


def closed(state: KeyframeOdometry) -> MapClosure:
    maps = [segment for segment in state.segments if segment.started]
    return close_maps(maps, keyframe_poses(maps, room.INTRINSICS), room.INTRINSICS)


@pytest.mark.slow
def test_maps_before_and_after_a_loss_are_joined_where_the_camera_is_rolled_and_closer():
    truth, state = lost_on_the_way()
    assert sum(segment.started for segment in state.segments) == 2
    assert [event.event for event in state.events] == ["map begun", "lost", "map begun"]
    after = closed(state)
    assert len(set(after.poses.segments.values())) == 1
    (join,) = after.joins
    assert join.event == "map joined"
    assert join.other is not None
    assert join.other < 22 < 29 <= join.frame
    position, rotation = room.errors(after.poses, truth)
    assert position < 0.01
    assert rotation < 0.3
    for pose, loop in zip(after.poses.loops, after.loops.accepted, strict=True):
        T = invert(truth[pose.from_index]) @ truth[pose.to_index]
        assert np.rad2deg(rotation_angle(T[:3, :3].T @ loop.measured.T_from_to[:3, :3])) < 3.0


def lap(number: int, forth: bool, unit: float) -> LocalMap:
    """Eight keyframes two metres along a wall, or back along the one behind, in ``unit`` metres."""
    rng = np.random.default_rng(int(forth))
    points = rng.uniform([-3.0, -2.0, 4.0], [5.0, 2.0, 7.0], (300, 3))
    R = np.eye(3)
    if not forth:
        R, points[:, 2] = np.diag([-1.0, 1.0, -1.0]), -points[:, 2]
    along = np.linspace(0.0, 2.0, 8)
    T_world_camera = np.array([make(R, np.array([x, 0.0, 0.0])) for x in along])
    T_map_world = invert(T_world_camera[0 if forth else -1])
    keyframes = []
    for k, T in enumerate(T_world_camera if forth else T_world_camera[::-1]):
        seen = apply(invert(T), points)
        pixels = room.INTRINSICS.project(seen)
        size = room.INTRINSICS.width, room.INTRINSICS.height
        tracks = np.flatnonzero(((pixels >= 0) & (pixels < size)).all(axis=1))
        T_map_camera = T_map_world @ T
        T_map_camera[:3, 3] /= unit
        pixels, depth = pixels[tracks], seen[tracks, 2] / unit
        none = np.zeros((len(tracks), 32), np.uint8)
        own = 8 * number + k, invert(T_map_camera), tracks, pixels, pixels, depth, none, None
        keyframes.append(TrackedKeyframe(*own))
    return LocalMap(keyframes, apply(T_map_world, points) / unit, [], True)


def test_the_unit_of_one_wall_follows_from_two_laps_and_the_turns_between_them(
    monkeypatch: pytest.MonkeyPatch,
):
    """Loops join each wall's maps, three turns lead from one wall to the other, whose unit is 1.6 times as long."""
    maps = [lap(number, number % 2 == 0, 1.6 if number % 2 else 1.0) for number in range(4)]
    half = make(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    for number, each in enumerate(maps[:-1]):
        sigmas = np.repeat([0.01, 0.1], 3)
        last = 8 * number + 7
        each.turns.append(RelativePose(last, last + 1, half, sigmas, KEYFRAME_SOURCE))

    def find(*arguments: Any) -> LoopClosures:
        loops = []
        for earlier, later in ((0, 2), (1, 3)):
            for k in range(0, 8, 2):
                one, other = (maps[number].keyframes[k] for number in (earlier, later))
                rows = np.arange(len(one.track_ids))
                T = one.T_camera_world @ invert(other.T_camera_world)
                sigmas = np.full(6, 0.01)
                pose = RelativePose(one.index, other.index, T, sigmas, LOOP_SOURCE)
                loops.append(Loop(pose, 50, 1.0, 1.0, np.column_stack([rows, rows])))
        return LoopClosures(len(loops), len(loops), tuple(loops))

    monkeypatch.setattr(map_closure, "find_loops", find)
    after = close_maps(maps, keyframe_poses(maps, room.INTRINSICS), room.INTRINSICS)
    assert set(after.poses.segments.values()) == {0}
    positions = np.array([after.poses.T_map_camera[k][:3, 3] for k in range(32)])
    lap_once = np.concatenate([np.linspace(0.0, 2.0, 8), np.linspace(2.0, 0.0, 8)])
    along = 2.0 / positions[7, 0] * positions[:, 0]
    np.testing.assert_allclose(along, np.tile(lap_once, 2), atol=0.15)


@pytest.mark.slow
def test_another_scene_is_no_loop():
    walked = room.there_and_back(110)
    after = closed(room.tracked(np.concatenate([walked[:45], walked[:45]]), [0] * 45 + [7] * 45))
    assert after.loops.accepted == ()
    assert after.joins == ()
    assert len(set(after.poses.segments.values())) == 2


@pytest.mark.data
@pytest.mark.slow
def test_a_real_hand_held_recording_and_its_loops(data_root: Path):
    """With flat learned depth: no network takes part."""
    recording = data_root / "handheld_kitchen"
    sequence = open_sequence(recording / "images")
    indices = range(0, 320, 4)
    truth = np.loadtxt(recording / "poses.kitti.txt").reshape(-1, 3, 4)
    odometry = KeyframeOdometry(sequence.intrinsics)
    flat = np.ones((sequence.intrinsics.height, sequence.intrinsics.width), np.float32)
    for k in indices:
        frame = replace(sequence.frame(k), index=k // 4)
        odometry.follow(frame)
        odometry.learn(frame, flat)
    maps = odometry.segments
    before = keyframe_poses(maps, sequence.intrinsics)
    after = close_maps(maps, before, sequence.intrinsics)
    T_world_camera = np.tile(np.eye(4), (len(truth), 1, 1))
    T_world_camera[:, :3] = truth
    assert sorted(before.segments) == list(range(80))
    T_world_camera = T_world_camera[indices]
    assert len(after.loops.accepted) >= 8
    for pose in after.poses.loops:
        T = invert(T_world_camera[pose.from_index]) @ T_world_camera[pose.to_index]
        assert np.rad2deg(rotation_angle(T[:3, :3].T @ pose.T_from_to[:3, :3])) < 5.0
    error = room.errors(before, T_world_camera)[0]
    assert error < 0.04
    assert room.errors(after.poses, T_world_camera)[0] < 0.95 * error
