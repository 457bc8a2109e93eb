"""A hand-held camera in a drawn room is followed by keyframes."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import room

from slam.frames import KEYFRAME_SOURCE, Frame
from slam.frontend.keyframes.odometry import KeyframeOdometry
from slam.frontend.keyframes.relative_poses import KeyframePoses, chained, keyframe_poses
from slam.geometry.se3 import from_rotation_vector, invert, rotation_angle


def poses(state: KeyframeOdometry) -> KeyframePoses:
    return keyframe_poses(state.segments, room.INTRINSICS)


def test_a_hand_held_camera_is_followed():
    truth = room.walk(70)
    state = room.tracked(truth)
    found = poses(state)
    T = chained(found.poses)
    path = np.array([T[k][:3, 3] for k in range(70)])
    assert {pose.source for pose in found.poses} == {KEYFRAME_SOURCE}
    assert 4 <= len(state.segments[0].keyframes) <= 30
    error, turned_deg = room.errors(found, truth)
    extent, estimated = (np.linalg.norm(np.std(p, axis=0)) for p in (truth[:, :3, 3], path))
    assert error < 0.04 * extent and turned_deg < 0.6
    # learned depth over depth gives the unit: 2 for the far wall, 4.4 for the near one
    assert 0.2 < extent / estimated < 0.55


@pytest.mark.parametrize("seed", [0, 5])
def test_a_map_begins_on_a_plane(seed: int):
    """A wall faced squarely fits many essential matrices: with seed 5 theirs turned the camera by 90 degrees."""
    truth = room.walk(30)
    assert room.errors(poses(room.tracked(truth, near=False, draws=seed)), truth)[1] < 1.5


def test_blur_of_a_turn_on_the_spot_is_no_motion():
    """Corners of blurred images agree on a translation: without the turn, rotations were 0.6 degrees off."""
    moments = room.walk(152, step_m=0.0, turn=0.005)
    odometry = KeyframeOdometry(room.INTRINSICS)
    for k in range(38):
        exposed = [room.image(T) for T in moments[4 * k : 4 * k + 3]]
        view = Frame(k, k / 30.0, np.mean(exposed, axis=0).astype(np.uint8))
        odometry.follow(view)
        odometry.learn(view, room.depth_map(np.eye(4)))
    T = odometry.segments[0].T_world_camera
    true = moments[[4 * keyframe.index + 1 for keyframe in odometry.segments[0].keyframes]]
    turned = rotation_angle(np.swapaxes(T[:, :3, :3], 1, 2) @ (invert(true[0]) @ true)[:, :3, :3])
    assert np.rad2deg(turned).max() < 0.35


def test_standing_after_a_walk_adds_no_keyframe_and_does_not_drift():
    walked = room.walk(30)
    state = room.tracked(np.concatenate([walked, np.repeat(walked[-1:], 25, axis=0)]))
    keyframes = state.segments[0].keyframes
    assert keyframes[-1].index <= 31
    T = chained(poses(state).poses)
    stood = np.linalg.norm(np.stack([T[k][:3, 3] - T[32][:3, 3] for k in range(32, 55)]), axis=1)
    travelled = np.linalg.norm(T[29][:3, 3])
    assert stood.max() < 0.005 * travelled


@pytest.mark.slow
def test_another_scene_begins_another_map():
    walked = room.walk(60)
    state = room.tracked(walked, [0] * 25 + [7] * 35)
    found = poses(state)
    assert len(set(found.segments.values())) == 2
    assert max(frame for frame, number in found.segments.items() if number == 0) < 25
    assert not any(pose.from_index < 25 <= pose.to_index for pose in found.poses)
    images = [
        [keyframe.grey is not None for keyframe in segment.keyframes] for segment in state.segments
    ]
    assert not any(images[0]) and any(images[1])


def test_a_walk_that_begins_with_a_turn_is_one_map():
    """A turn of 33 degrees, by 3 a frame: no corner of the first image is left in the end."""
    yaw = np.deg2rad(np.arange(-33.0, 0.0, 3.0))
    turned = from_rotation_vector(np.outer(yaw, [0.0, 1.0, 0.0]), np.zeros((len(yaw), 3)))
    truth = np.concatenate([turned, room.walk(30)])
    state = room.tracked(truth)
    assert [event.event for event in state.events] == ["map begun"]
    found = poses(state)
    assert sorted(found.segments) == list(range(len(truth)))
    for pose in found.poses:
        T_true = invert(truth[pose.from_index]) @ truth[pose.to_index]
        assert np.rad2deg(rotation_angle(pose.T_from_to[:3, :3].T @ T_true[:3, :3])) < 1.0
        assert pose.to_index >= len(yaw) or np.linalg.norm(pose.T_from_to[:3, 3]) < 0.02 * room.FAR


def test_without_learned_depth_there_is_no_map():
    odometry = KeyframeOdometry(room.INTRINSICS)
    for k, T in enumerate(room.walk(6)):
        view = room.frame(k, T)
        odometry.follow(view)
        odometry.learn(
            view, np.full((room.INTRINSICS.height, room.INTRINSICS.width), np.nan, np.float32)
        )
    assert poses(odometry).poses == [] and not odometry.events
    assert [segment.started for segment in odometry.segments] == [False]


@pytest.mark.parametrize(("step_m", "turn"), [(0.006, 0.0), (0.003, 0.1)])
def test_a_short_way_has_its_length_by_learned_depth(step_m: float, turn: float):
    """A hundredth of the depth is too little parallax for points of their own; learned depth is twice the depth."""
    frames = np.arange(8.0)
    truth = from_rotation_vector(
        np.outer(frames, [0.0, turn, 0.0]), np.outer(frames, [step_m, 0.0, 0.0])
    )
    T = chained(poses(room.tracked(truth, near=False)).poses)
    np.testing.assert_allclose(T[7][:3, 3], [14 * step_m, 0.0, 0.0], atol=0.02)


def test_where_no_corner_is_tracked_the_whole_image_gives_the_turn():
    """Between sharp and blurred images: the camera turns on in the same map."""
    yaw = np.concatenate([np.zeros(5), np.deg2rad(np.arange(1.0, 13.0))])
    truth = from_rotation_vector(np.outer(yaw, [0.0, 1.0, 0.0]), np.zeros((len(yaw), 3)))
    odometry = KeyframeOdometry(room.INTRINSICS)
    for k, T in enumerate(truth):
        view = room.frame(k, T)
        if 5 <= k < 12:
            view = replace(view, image=cv2.GaussianBlur(view.image, (0, 0), 5.0))
        odometry.follow(view)
        odometry.learn(view, room.depth_map(T))
    assert [event.event for event in odometry.events] == ["map begun"]
    T = chained(poses(odometry).poses)
    assert sorted(T) == list(range(len(truth)))
    turned = rotation_angle(
        np.stack([T[k][:3, :3].T @ truth[k, :3, :3] for k in range(len(truth))])
    )
    assert np.rad2deg(turned).max() < 3.1
