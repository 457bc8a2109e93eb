import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import room

from slam.frames import LOOP_SOURCE, RelativePose, View
from slam.frontend.keyframes.odometry import KeyframeOdometry
from slam.frontend.keyframes.relative_poses import keyframe_poses
from slam.geometry.se3 import FloatArray, invert, rotation_angle
from slam.loops.closure import LoopClosures, Track, find_loops
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
def test_maps_before_and_after_a_loss_are_joined_where_the_camera_is_rolled_and_closer() -> None:
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


@pytest.mark.filterwarnings(
    "ignore:Mean of empty slice", "ignore:invalid value"
)  # it has no corners
@pytest.mark.slow
def test_maps_are_joined_where_a_loop_within_one_of_them_has_more_inliers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The loop within the first map is added by hand, for in this small room the window finds such places itself."""

    def find(views: Sequence[View], track: Track, *rest: Any) -> LoopClosures:
        closures = find_loops(views, track, *rest)
        last = int(np.flatnonzero(track.maps == 0)[-1])
        T = invert(track.T_world_camera[0]) @ track.T_world_camera[last]
        within = RelativePose(
            int(track.frames[0]), int(track.frames[last]), T, np.full(6, 0.01), LOOP_SOURCE
        )
        loop = Loop(within, 1 + max(loop.inliers for loop in closures.accepted), 1.0)
        return replace(closures, accepted=(*closures.accepted, loop))

    monkeypatch.setattr(map_closure, "find_loops", find)
    back, closer = (
        room.there_and_back(90, roll=0.02),
        room.there_and_back(110, roll=0.5, closer=0.3),
    )
    truth = np.concatenate([back, back[:6], closer[95:]])
    after = closed(room.tracked(truth, [0] * 90 + [9] * 6 + [0] * 15))
    assert [event.event for event in after.joins] == ["map joined"]
    assert room.errors(after.poses, truth)[0] < 0.01


@pytest.mark.slow
def test_another_scene_is_no_loop() -> None:
    walked = room.there_and_back(110)
    after = closed(room.tracked(np.concatenate([walked[:45], walked[:45]]), [0] * 45 + [7] * 45))
    assert after.loops.accepted == ()
    assert after.joins == ()
    assert len(set(after.poses.segments.values())) == 2


@pytest.mark.data
@pytest.mark.slow
def test_a_real_hand_held_recording_and_its_loops(data_root: Path) -> None:
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
