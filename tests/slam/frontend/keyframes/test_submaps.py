from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.frames import Intrinsics
from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe
from slam.frontend.keyframes.relative_poses import keyframe_poses
from slam.frontend.keyframes.submaps import parts_of
from slam.frontend.keyframes.units import learned_unit
from slam.geometry.se3 import FloatArray, apply, from_rotation_vector, invert, rotation_angle

CAMERA = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
WALK = 15  # keyframes before the turn, and after it
TURN = 8


def cameras() -> FloatArray:
    """A camera that walks sideways for 1.5 m, turns on the spot by 90 degrees, and walks sideways again."""
    yaw = np.concatenate(
        [np.zeros(WALK), np.linspace(0, np.pi / 2, TURN), np.full(WALK, np.pi / 2)]
    )
    x = np.concatenate([np.linspace(-1.5, 0, WALK), np.zeros(TURN + WALK)])
    z = np.concatenate([np.zeros(WALK + TURN), -np.linspace(0, 1.5, WALK)])
    centres = np.column_stack([x, np.zeros(len(x)), z])
    return from_rotation_vector(np.outer(yaw, [0.0, 1.0, 0.0]), centres)


def walked(unit_after: float, learned_sigma: float) -> LocalMap:
    """A map whose unit is another one after the turn, with learned depth that is off by image."""
    rng = np.random.default_rng(0)
    angle, distance = rng.uniform(-0.7, 2.3, 1500), rng.uniform(3, 6, 1500)
    points = np.column_stack(
        [distance * np.sin(angle), rng.uniform(-2, 2, 1500), distance * np.cos(angle)]
    )
    T_world_camera = cameras()
    after = np.arange(len(T_world_camera)) >= WALK + TURN
    visible = []
    for T in T_world_camera:
        X = apply(invert(T), points)
        visible.append(
            np.flatnonzero(
                (X[:, 2] > 0.5) & (np.abs(X[:, :2] / X[:, 2:]) < [0.6, 0.45]).all(axis=1)
            )
        )
    old = np.unique(np.concatenate(visible[:WALK]))
    new = np.setdiff1d(np.arange(len(points)), old)
    local = LocalMap(points=points.copy())
    local.points[new] *= unit_after
    for index, (T, tracks, is_after) in enumerate(zip(T_world_camera, visible, after, strict=True)):
        tracks = np.setdiff1d(tracks, old) if is_after else tracks
        depth = apply(invert(T), points[tracks])[:, 2] * np.exp(rng.normal(0.0, learned_sigma))
        T_map = T.copy()
        T_map[:3, 3] *= unit_after if is_after else 1.0
        nowhere, nothing = np.zeros((len(tracks), 2)), np.zeros((len(tracks), 32), np.uint8)
        local.add(
            TrackedKeyframe(index, invert(T_map), tracks, nowhere, nowhere, depth, nothing, None)
        )
    return replace(local, started=True)


def length(part: LocalMap) -> float:
    """Of the way from the first keyframe to the last, in the unit of learned depth."""
    centre = invert(np.array([keyframe.T_camera_world for keyframe in part.keyframes]))[:, :3, 3]
    return float(np.linalg.norm(centre[-1] - centre[0])) * learned_unit(part)


@pytest.mark.parametrize(("unit_after", "off"), [(0.85, 0.05), (1.2, 0.05), (3.0, 0.12)])
def test_a_map_is_cut_where_no_point_carries_the_unit(unit_after: float, off: float):
    segment = walked(unit_after, learned_sigma=0.02)
    before, after = parts_of(segment, CAMERA)
    assert [k.index for k in after.keyframes] == list(
        range(after.keyframes[0].index, 2 * WALK + TURN)
    )
    assert before.keyframes[0].index == 0 and after.keyframes[0].index >= WALK
    assert length(before) == pytest.approx(1.5, rel=off) and length(after) == pytest.approx(
        1.5, rel=0.12
    )


def test_turns_lead_from_one_part_to_the_next():
    parts = parts_of(walked(0.85, learned_sigma=0.0), CAMERA)
    found, truth = keyframe_poses(parts, CAMERA), cameras()
    last, first = parts[0].keyframes[-1].index, parts[1].keyframes[0].index
    outside = [
        pose
        for pose in found.poses
        if found.segments[pose.from_index] != found.segments.get(pose.to_index)
    ]
    assert all(found.is_inside(pose) for pose in outside)
    assert {pose.from_index for pose in parts[0].turns} == set(range(last, first))
    for pose in parts[0].turns:
        T_true = invert(truth[pose.from_index]) @ truth[pose.to_index]
        np.testing.assert_allclose(
            rotation_angle(pose.T_from_to[:3, :3].T @ T_true[:3, :3]), 0.0, atol=1e-6
        )
        assert np.abs(pose.T_from_to[:3, 3] - T_true[:3, 3]).max() < 3.0 * pose.sigmas[3]


def test_keyframes_that_share_no_point_are_in_two_parts():
    segment = walked(1.0, learned_sigma=0.0)
    middle = WALK // 2
    local = LocalMap(segment.keyframes[:WALK], np.tile(segment.points, (2, 1)))
    for k in range(middle, WALK):
        keyframe = local.keyframes[k]
        local.keyframes[k] = keyframe.with_corners(
            np.arange(len(keyframe.track_ids)), keyframe.track_ids + 1500
        )
    before, after = parts_of(replace(local, started=True), CAMERA)
    assert (
        after.keyframes[0].index == middle + 1
    )  # where points of the keyframe before have parallax
    by_image, by_points = before.turns
    assert by_image.ends == (middle - 1, middle) and by_points.ends == (middle, middle + 1)
    way = np.linalg.norm(cameras()[middle, :3, 3] - cameras()[middle - 1, :3, 3])
    assert not by_image.T_from_to[:3, 3].any() and by_image.sigmas[3] > 0.9 * way
    assert by_image.sigmas[0] == pytest.approx(np.deg2rad(0.5)) and by_points.sigmas[
        0
    ] == pytest.approx(np.deg2rad(0.1))


def test_a_map_whose_points_carry_the_unit_is_one_part():
    segment = walked(1.0, learned_sigma=0.3)
    (part,) = parts_of(LocalMap(segment.keyframes[:WALK], segment.points, started=True), CAMERA)
    assert [keyframe.index for keyframe in part.keyframes] == list(range(WALK)) and not part.turns


def test_a_map_of_one_keyframe_is_one_part():
    segment = walked(1.0, learned_sigma=0.3)
    alone = LocalMap(segment.keyframes[:1], segment.points, started=True)
    assert [len(part.keyframes) for part in parts_of(alone, CAMERA)] == [1]
