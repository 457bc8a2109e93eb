import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import room

from slam.config.sections import KeyframesConfig, SlamConfig
from slam.frames import LOOP_SOURCE, RelativePose, View
from slam.frontend.drive import Drive
from slam.frontend.keyframes.odometry import KeyframeOdometry
from slam.frontend.keyframes.relative_poses import KeyframePoses, chained, keyframe_poses
from slam.geometry.se3 import FloatArray, from_rotation_vector, invert, rotation_angle, umeyama
from slam.loops.closure import LoopClosures, Track, find_loops
from slam.loops.recognition import Loop
from slam.pipeline import map_closure
from slam.pipeline.keyframe_tracking import KeyframeTracking
from slam.pipeline.map_closure import MapClosure, close_maps
from slam.sequences.catalogue import open_sequence

CONFIG = SlamConfig()


def there_and_back(frames: int, roll: float = 0.0, closer: float = 0.0) -> FloatArray:
    """Down along both walls, turning away from the start, and back to it, rolled and closer."""
    phase = np.linspace(0.0, 1.0, frames)
    away = np.sin(np.pi * phase)
    centres = np.column_stack([0.2 * np.sin(4 * np.pi * phase), 1.3 * away, closer * phase])
    turns = np.column_stack([-0.35 * away, 0.02 * np.sin(9.0 * phase), roll * phase])
    return from_rotation_vector(turns, centres)


@functools.cache
def lost_on_the_way() -> tuple[FloatArray, KeyframeOdometry]:
    """Two maps, and the true poses; on the way back the camera is rolled and closer."""
    walked = there_and_back(80, roll=0.4, closer=0.3)
    truth = np.concatenate([walked[:22], walked[35:]])
    return truth, room.tracked(truth, [0] * 22 + [9] * 7 + [0] * 38)


def closed(state: KeyframeOdometry) -> MapClosure:
    maps = [segment for segment in state.segments if segment.started]
    return close_maps(maps, keyframe_poses(maps, room.INTRINSICS), room.INTRINSICS)


def errors(found: KeyframePoses, truth: FloatArray) -> tuple[float, float]:
    """Of the last map: root mean square of aligned positions, largest of rotations since its first frame in degrees."""
    last = max(found.segments.values())
    poses = [pose for pose in found.poses if found.segments[pose.to_index] == last]
    T = chained(poses)
    frames = sorted(T)
    estimate, true = np.stack([T[k] for k in frames]), truth[frames]
    similarity = umeyama(true[:, :3, 3], estimate[:, :3, 3], with_scale=True)
    aligned = similarity.apply_to_poses(estimate)
    distance = np.linalg.norm(aligned[:, :3, 3] - true[:, :3, 3], axis=1)
    since_first = true[0, :3, :3].T @ true[:, :3, :3]
    turned = rotation_angle(np.swapaxes(estimate[:, :3, :3], 1, 2) @ since_first)
    return float(np.sqrt((distance**2).mean())), float(np.rad2deg(turned).max())


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
    position, rotation = errors(after.poses, truth)
    assert position < 0.01
    assert rotation < 0.3
    for pose, loop in zip(after.poses.loops, after.loops.accepted, strict=True):
        T = invert(truth[pose.from_index]) @ truth[pose.to_index]
        assert np.rad2deg(rotation_angle(T[:3, :3].T @ loop.measured.T_from_to[:3, :3])) < 3.0


@pytest.mark.filterwarnings("ignore:Mean of empty slice", "ignore:invalid value")  # it has no corners
@pytest.mark.slow
def test_maps_are_joined_where_a_loop_within_one_of_them_has_more_inliers(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop within the first map is added by hand, for in this small room the window finds such places itself."""

    def find(views: Sequence[View], track: Track, *rest: Any) -> LoopClosures:
        closures = find_loops(views, track, *rest)
        last = int(np.flatnonzero(track.maps == 0)[-1])
        T = invert(track.T_world_camera[0]) @ track.T_world_camera[last]
        within = RelativePose(int(track.frames[0]), int(track.frames[last]), T, np.full(6, 0.01), LOOP_SOURCE)
        loop = Loop(within, 1 + max(loop.inliers for loop in closures.accepted), 1.0)
        return replace(closures, accepted=(*closures.accepted, loop))

    monkeypatch.setattr(map_closure, "find_loops", find)
    back, closer = there_and_back(90, roll=0.02), there_and_back(110, roll=0.5, closer=0.3)
    truth = np.concatenate([back, back[:6], closer[95:]])
    after = closed(room.tracked(truth, [0] * 90 + [9] * 6 + [0] * 15))
    assert [event.event for event in after.joins] == ["map joined"]
    assert errors(after.poses, truth)[0] < 0.01


def tracked(truth: FloatArray, unseen: Sequence[int], sparse: Sequence[int] = ()) -> KeyframeTracking:
    """After some frames, of which some show another scene, and some have no depth."""
    tracking = KeyframeTracking(KeyframesConfig(use="always"), CONFIG.loops, room.INTRINSICS, 0)
    for k, T in enumerate(truth):
        frame = room.frame(k, T, 9 if k in unseen else 0)
        tracking.follow(frame)
        if k not in sparse:
            tracking.learn(frame, room.depth_map(T))
    return tracking


def test_after_a_short_loss_the_camera_is_found_again_in_its_map() -> None:
    walked = there_and_back(110, roll=0.4, closer=0.3)
    truth = np.concatenate([walked[:60], walked[82:]])
    tracking = tracked(truth, range(60, 66))
    _, lost, found = tracking.events
    assert (lost.event, lost.frame) == ("lost", 60)
    assert (found.event, found.frame) == ("relocalised", 66)
    assert found.other is not None
    assert found.other < 40
    poses = keyframe_poses(tracking.maps(Drive()), room.INTRINSICS)
    assert set(poses.segments) == {*range(60), *range(66, 88)}
    position, rotation = errors(poses, truth)
    assert position < 0.01
    assert rotation < 0.3


@pytest.mark.parametrize(
    ("places", "unseen", "sparse", "relocalised"),
    [
        pytest.param([*range(60), *range(82, 89), *range(35, 38)], range(60, 66), (), [66, 67], marks=pytest.mark.slow),
        pytest.param([*range(61), 68, 60, 8], (60, 62), (61,), [63], marks=pytest.mark.slow),
        pytest.param([*range(70), 40, 41], range(60, 70), (), [], marks=pytest.mark.slow),
    ],
    ids=["relocalised before", "located in a frame without depth before", "in a map that has just begun"],
)
def test_a_camera_that_is_lost_again_at_once_is_found_in_the_map_as_it_then_is(
    places: list[int], unseen: Sequence[int], sparse: Sequence[int], relocalised: list[int]
) -> None:
    truth = there_and_back(110, roll=0.4, closer=0.3)[places]
    events = tracked(truth, unseen, sparse).events
    assert [each.frame for each in events if each.event == "relocalised"] == relocalised


@pytest.mark.slow
def test_another_scene_is_no_loop() -> None:
    walked = there_and_back(110)
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
    error = errors(before, T_world_camera)[0]
    assert error < 0.04
    assert errors(after.poses, T_world_camera)[0] < 0.95 * error
