from __future__ import annotations

import numpy as np
import pytest

from slam.frames import Intrinsics
from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe
from slam.frontend.keyframes.map_segment import MapSegment
from slam.frontend.keyframes.unit import evened, learned_unit
from slam.geometry.se3 import FloatArray, apply, from_rotation_vector, invert

CAMERA = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
WALK = 15  # keyframes before the turn, and after it
TURN = 8


def cameras() -> FloatArray:
    """A camera that walks sideways for 1.5 m, turns on the spot by 90 degrees, and walks sideways again."""
    yaw = np.concatenate([np.zeros(WALK), np.linspace(0, np.pi / 2, TURN), np.full(WALK, np.pi / 2)])
    x = np.concatenate([np.linspace(-1.5, 0, WALK), np.zeros(TURN + WALK)])
    z = np.concatenate([np.zeros(WALK + TURN), -np.linspace(0, 1.5, WALK)])
    centres = np.column_stack([x, np.zeros(len(x)), z])
    return from_rotation_vector(np.outer(yaw, [0.0, 1.0, 0.0]), centres)


def walked(unit_after: float, learned_sigma: float) -> MapSegment:
    """A map whose unit is another one after the turn, with learned depth that is off by image."""
    rng = np.random.default_rng(0)
    angle, distance = rng.uniform(-0.7, 2.3, 1500), rng.uniform(3, 6, 1500)
    points = np.column_stack([distance * np.sin(angle), rng.uniform(-2, 2, 1500), distance * np.cos(angle)])
    T_world_camera = cameras()
    after = np.arange(len(T_world_camera)) >= WALK + TURN
    visible = []
    for T in T_world_camera:
        X = apply(invert(T), points)
        visible.append(np.flatnonzero((X[:, 2] > 0.5) & (np.abs(X[:, :2] / X[:, 2:]) < [0.6, 0.45]).all(axis=1)))
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
        local.add(TrackedKeyframe(index, invert(T_map), tracks, nowhere, nowhere, depth, nothing, None))
    return MapSegment(local, started=True)


def walks(segment: MapSegment) -> tuple[float, float]:
    """Length of the way before the turn and after it."""
    centre = invert(np.array([keyframe.T_camera_world for keyframe in segment.map.keyframes]))[:, :3, 3]
    return float(np.linalg.norm(centre[WALK - 1] - centre[0])), float(np.linalg.norm(centre[-1] - centre[-WALK]))


@pytest.mark.parametrize("unit_after", [0.85, 1.2])
def test_a_unit_that_changes_in_a_turn_is_evened_by_learned_depth(unit_after: float) -> None:
    segment = walked(unit_after, learned_sigma=0.1)
    even = evened(segment, CAMERA)
    before, after = walks(even)
    assert walks(segment)[1] / walks(segment)[0] == pytest.approx(unit_after)
    assert after / before == pytest.approx(1.0, abs=0.08)
    assert before * learned_unit(even.map) == pytest.approx(1.5, rel=0.1)


def test_points_follow_their_keyframes() -> None:
    even = evened(walked(0.85, learned_sigma=0.0), CAMERA)
    for keyframe in (even.map.keyframes[0], even.map.keyframes[-1]):
        depth = apply(keyframe.T_camera_world, even.map.points[keyframe.track_ids])[:, 2]
        assert np.median(depth * learned_unit(even.map) / keyframe.learned_depth) == pytest.approx(1.0, abs=0.03)


def test_a_map_whose_points_carry_the_unit_stays_as_it_is() -> None:
    segment = walked(1.0, learned_sigma=0.3)
    local = LocalMap(segment.map.keyframes[:WALK], segment.map.points)
    segment = MapSegment(local, started=True)
    assert evened(segment, CAMERA) is segment
