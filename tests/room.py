"""Images of a hand-held camera in a room of two textured walls, one behind the other."""

from __future__ import annotations

import functools

import cv2
import numpy as np

from slam.frames import Frame, Intrinsics
from slam.frontend.keyframes.odometry import KeyframeOdometry
from slam.geometry.se3 import FloatArray, from_rotation_vector, invert

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
