"""Images of a hand-held camera in a room of two textured walls, one behind the other."""

from __future__ import annotations

import functools

import cv2
import numpy as np

from slam.frames import Frame, Intrinsics
from slam.frontend.keyframes.odometry import KeyframeOdometry
from slam.frontend.keyframes.relative_poses import KeyframePoses, chained
from slam.geometry.se3 import FloatArray, from_rotation_vector, invert, rotation_angle, umeyama

INTRINSICS = Intrinsics(width=320, height=240, fx=290.0, fy=290.0, cx=159.5, cy=119.5)
FAR, NEAR = 4.0, 1.8
_PX_PER_M = 120.0


@functools.cache
def texture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 255, (100, 130), np.uint8)
    return cv2.GaussianBlur(
        cv2.resize(coarse, None, fx=8, fy=8, interpolation=cv2.INTER_NEAREST), (0, 0), 1.2
    )


def image(T_world_camera: FloatArray, seed: int = 0, near: bool = True) -> np.ndarray:
    """The far wall, and the near one, if it is there, over the left half of it."""
    T = invert(T_world_camera)
    drawn = None
    for depth, wall in ((FAR, texture(seed)), (NEAR, texture(seed + 1)))[: 2 if near else 1]:
        height, width = wall.shape
        left = -width / _PX_PER_M / 2 if depth == FAR else -width / _PX_PER_M + 0.1
        place = np.array(
            [[1 / _PX_PER_M, 0, left], [0, 1 / _PX_PER_M, -height / _PX_PER_M / 2], [0, 0, depth]]
        )
        H = INTRINSICS.K @ (T[:3, :3] @ place + np.outer(T[:3, 3], [0, 0, 1.0]))
        size = INTRINSICS.width, INTRINSICS.height
        if drawn is None:
            drawn = cv2.warpPerspective(wall, H, size, borderMode=cv2.BORDER_REFLECT)
        else:
            over = cv2.warpPerspective(np.full_like(wall, 255), H, size)
            drawn = np.where(over > 127, cv2.warpPerspective(wall, H, size), drawn)
    return np.repeat(drawn[:, :, None], 3, axis=2)


def depth_map(T_world_camera: FloatArray) -> np.ndarray:
    """Roughly: the distance of the far wall everywhere, times two."""
    return np.full(
        (INTRINSICS.height, INTRINSICS.width), 2.0 * (FAR - T_world_camera[2, 3]), np.float32
    )


def walk(frames: int, step_m: float = 0.03, turn: float = 0.004) -> FloatArray:
    """A camera carried to and fro, shaking a little."""
    rng = np.random.default_rng(5)
    phase = np.arange(frames) * 0.08
    centres = (
        np.column_stack([np.sin(phase), 0.4 * np.sin(0.7 * phase), 0.5 * np.sin(0.5 * phase)])
        * step_m
        / 0.08
    )
    turns = (
        np.column_stack([np.sin(0.9 * phase), np.sin(0.6 * phase), np.sin(0.8 * phase)])
        * turn
        / 0.08
    )
    T = from_rotation_vector(turns + rng.normal(0.0, 0.0005, (frames, 3)), centres)
    return invert(T[0]) @ T


def frame(index: int, T_world_camera: FloatArray, seed: int = 0, near: bool = True) -> Frame:
    return Frame(index, index / 30.0, image(T_world_camera, seed, near))


def tracked(
    T_world_camera: FloatArray, seeds: list[int] | None = None, near: bool = True, draws: int = 0
) -> KeyframeOdometry:
    """After the frames of a camera; each shows the walls of its seed. ``draws`` is the seed of RANSAC."""
    odometry = KeyframeOdometry(INTRINSICS, draws)
    for k, T in enumerate(T_world_camera):
        view = frame(k, T, 0 if seeds is None else seeds[k], near)
        odometry.follow(view)
        odometry.learn(view, depth_map(T))
    return odometry


def there_and_back(frames: int, roll: float = 0.0, closer: float = 0.0) -> FloatArray:
    """A walk down along both walls, turning away from the start, and back to it, rolled and closer."""
    phase = np.linspace(0.0, 1.0, frames)
    away = np.sin(np.pi * phase)
    centres = np.column_stack([0.2 * np.sin(4 * np.pi * phase), 1.3 * away, closer * phase])
    turns = np.column_stack([-0.35 * away, 0.02 * np.sin(9.0 * phase), roll * phase])
    return from_rotation_vector(turns, centres)


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
