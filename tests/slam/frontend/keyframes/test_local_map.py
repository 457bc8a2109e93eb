from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from slam.frames import Intrinsics
from slam.frontend.keyframes.local_map import LocalMap, NewImage, TrackedFrame, TrackedKeyframe
from slam.geometry.se3 import FloatArray, apply, invert, make

CAMERA = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
TRACKS, KNOWN = 60, 30


def scene() -> FloatArray:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-2, 2, (TRACKS, 2)), rng.uniform(4, 6, TRACKS)])


def seen(
    index: int, T_world_camera: FloatArray, points: FloatArray, learned_unit: float | FloatArray
) -> TrackedKeyframe:
    T, nothing = invert(T_world_camera), np.zeros((TRACKS, 32), np.uint8)
    x, y, z = apply(T, points).T
    pixels = np.column_stack([500 * x / z + 319.5, 500 * y / z + 239.5])
    return TrackedKeyframe(
        index, T, np.arange(TRACKS), pixels, pixels, learned_unit * z, nothing, None
    )


def along(x: float) -> FloatArray:
    return make(np.eye(3), np.array([x, 0.0, 0.0]))


def test_new_points_have_the_unit_of_those_with_parallax():
    """Learned depth is half the depth, by most of the known points, whose parallax is small, the whole depth."""
    points = scene()
    far = np.arange(KNOWN) < 0.6 * KNOWN
    points[:KNOWN][far] *= 200.0
    local = LocalMap(points=points.copy())
    local.points[KNOWN:] = np.nan
    learned = np.full(TRACKS, 0.5)
    learned[:KNOWN][far] = 1.0
    for k in range(3):
        local.add(seen(k, along(0.5 * k), points, learned))
    local.add_points(CAMERA)
    in_camera = apply(local.keyframes[-1].T_camera_world, points[KNOWN:])
    np.testing.assert_allclose(
        apply(local.keyframes[-1].T_camera_world, local.points[KNOWN:]), in_camera, rtol=1e-9
    )
    np.testing.assert_array_equal(local.points[:KNOWN], points[:KNOWN])


def test_the_first_points_are_at_learned_depth_where_it_is_known():
    points = scene()
    local = LocalMap(points=np.full((TRACKS, 3), np.nan))
    local.add(seen(0, np.eye(4), points, 1.5))
    local.keyframes[0].learned_depth[:10] = np.nan
    local.keyframes[0].learned_depth[10] = 0.0
    local.add_points(CAMERA)
    np.testing.assert_allclose(local.points[11:], 1.5 * points[11:])
    assert np.isnan(local.points[:11]).all()


def test_points_without_parallax_are_uncertain_along_their_first_ray():
    points = scene()
    local = LocalMap(points=points.copy())
    local.add(seen(0, np.eye(4), points, 1.0))
    asked = 0.7 / CAMERA.fx, np.arange(TRACKS)
    np.testing.assert_allclose(local.parallax(local.keyframes).spread(*asked), 0.3 * points)
    local.add(seen(1, along(1.0), points, 1.0))
    spread = local.parallax(local.keyframes).spread(*asked)
    # 0.7 pixels over an angle of some ten degrees
    assert np.linalg.norm(np.cross(spread, points), axis=1).max() < 1e-9
    assert (np.linalg.norm(spread, axis=1) < 0.02 * np.linalg.norm(points, axis=1)).all()


def unit_after_a_walk(seed: int, keyframes: int = 10) -> float:
    """Of the last step of a map with half a pixel of noise, whose learned depth is 30 % too short in all images.

    Points have between 0.3 and 2 degrees of parallax, and start where two fixed keyframes are and the depth is learned.
    """
    rng = np.random.default_rng(seed)
    step = 0.02
    angle = np.deg2rad(rng.uniform(0.3, 2.0, TRACKS))
    z = keyframes * step / angle
    points = np.column_stack([z[:, None] * rng.uniform(-0.4, 0.4, (TRACKS, 2)), z])
    local = LocalMap(points=0.9 * points)
    for k in range(keyframes):
        keyframe = seen(k, along(step * k), points, 0.7 * np.exp(rng.normal(0.0, 0.1, TRACKS)))
        keyframe.pixels[:] += rng.normal(0.0, 0.5, (TRACKS, 2))
        local.add(keyframe)
    for k in range(2, keyframes):
        few = LocalMap(local.keyframes[: k + 1], local.points)
        few.adjust(CAMERA)
        local.keyframes[: k + 1], local.points = few.keyframes, few.points
    centres = invert(np.array([keyframe.T_camera_world for keyframe in local.keyframes]))[:, :3, 3]
    return float(np.linalg.norm(centres[-1] - centres[-2])) / step


def test_learned_depth_does_not_move_the_unit_of_a_map():
    units = np.log([unit_after_a_walk(seed) for seed in range(20)])
    assert abs(units.mean()) < 0.1


def test_adjustment_takes_the_unit_of_loose_points_from_themselves():
    """Points that have parallax stay where they are, although learned depth of the others has another unit."""
    points = scene()
    points[KNOWN:] *= 40.0
    local = LocalMap(points=points.copy())
    for k in range(4):
        local.add(seen(k, along(0.2 * k), points, np.where(np.arange(TRACKS) < KNOWN, 1.0, 3.0)))
    local.adjust(CAMERA)
    np.testing.assert_allclose(local.points, points, rtol=1e-3)
    np.testing.assert_allclose(local.keyframes[-1].T_camera_world, invert(along(0.6)), atol=1e-4)


def test_frames_go_along_with_their_keyframe_when_it_is_adjusted():
    points = scene()
    local = LocalMap(points=points.copy())
    for k in range(4):
        local.add(seen(2 * k, along(0.2 * k), points, 1.0))
    local.keyframes[3] = replace(local.keyframes[3], T_camera_world=invert(along(0.65)))
    frame = TrackedFrame(7, np.arange(0), np.zeros((0, 2), np.float32), invert(along(0.1)))
    local.adjust(CAMERA)
    np.testing.assert_allclose(local.T_camera_world(frame), invert(along(0.7)), atol=1e-3)


def test_a_step_of_a_sixth_of_the_image_is_followed_by_dense_flow():
    """A wall 4 m away whose texture has all sizes; corners that left the image are not found."""
    rng = np.random.default_rng(0)
    wall = np.zeros((800, 1200))
    for size in 2 ** np.arange(1, 8):
        grain = rng.normal(size=(800 // size + 1, 1200 // size + 1))
        wall += size * cv2.resize(grain, (1200, 800), interpolation=cv2.INTER_CUBIC)
    image = np.rint(np.clip(128.0 + 0.4 * wall, 0.0, 255.0)).astype(np.uint8)
    pixels = rng.uniform(20.0, [620.0, 460.0], (200, 2))
    shift = np.array([100.0, 30.0])
    tracks, nothing = np.arange(200), np.zeros((200, 32), np.uint8)
    here, there = image[100:580, 200:840].copy(), image[70:550, 100:740].copy()
    keyframe = TrackedKeyframe(0, np.eye(4), tracks, pixels, pixels, pixels[:, 0], nothing, here)
    found, flowed = NewImage(there, np.eye(4), CAMERA).flowed(keyframe)
    is_inside = (pixels + shift < [CAMERA.width - 1, CAMERA.height - 1]).all(axis=1)
    assert is_inside[found].all()
    right = np.linalg.norm(flowed - pixels[found] - shift, axis=1) < 1.0
    assert right.sum() > 0.7 * is_inside.sum()
    assert right.mean() > 0.9
