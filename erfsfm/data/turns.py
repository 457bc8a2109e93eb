"""Rotations of the camera at each frame, which a homography shows exactly: the motion between the images stays known."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from erfsfm.data.augmentation import Images
from erfsfm.geometry.camera import Camera

Rotations = NDArray[np.float64]

_TURNED = 0.7  # of the snippets; the others are as they are seen later, without a margin
_STEADY = np.array([0.25, 1.0, 0.15])  # of the largest angle at the snippet's ends, pitch, yaw and roll: a curve
_UNSTEADY = np.array([0.1, 0.1, 0.1])  # sigmas of each frame, of the same: a bumpy road
GREY = 128  # what lies outside: zero to the networks, as the padding of their convolutions


def random_turns(count: int, degrees: float, rng: np.random.Generator) -> Rotations:
    """Rotations ``R_turned_camera`` ``(count, 3, 3)`` of a snippet's frames: a curve about its middle, and shaking.

    Args:
        count: of the frames.
        degrees: largest yaw of the curve, from the middle to either end.
        rng: of all random draws.
    """
    if rng.random() >= _TURNED:
        return np.tile(np.eye(3), (count, 1, 1))
    along = np.linspace(-1, 1, count)[:, None]
    steady = along * _STEADY * rng.uniform(-degrees, degrees, 3)
    return Rotation.from_rotvec(np.radians(steady + degrees * _UNSTEADY * rng.normal(size=(count, 3)))).as_matrix()


def turned(images: Images, camera: Camera, R_turned_camera: Rotations) -> Images:
    """Images as a camera at the same place sees them that is rotated.

    A pixel that any of the images does not show, and its mirror images, are grey in all of them: the margin tells
    nothing of the way.

    Args:
        images: ``(H, W, 3)`` uint8 each.
        camera: of all of them.
        R_turned_camera: one rotation an image, ``(N, 3, 3)``.
    """
    K = camera.K.astype(np.float64)
    size = (camera.width, camera.height)
    shown = np.ones(size[::-1], dtype=np.uint8)
    moved, seen = [], shown.astype(bool)
    for image, R in zip(images, R_turned_camera, strict=True):
        H = K @ R @ np.linalg.inv(K)
        moved.append(cv2.warpPerspective(image, H, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        seen &= cv2.warpPerspective(shown, H, size, flags=cv2.INTER_NEAREST) > 0
    for mirror in (np.s_[:, ::-1], np.s_[::-1]):
        seen = seen & seen[mirror]
    for image in moved:
        image[~seen] = GREY
    return moved


def turned_motion(T_source_target: NDArray[np.float32], R_turned_camera: Rotations) -> NDArray[np.float32]:
    """Motion ``(N, 4, 4)`` between the rotated cameras, of N + 1 frames in time order, the target in the middle."""
    middle = len(T_source_target) // 2
    R_source = np.delete(R_turned_camera, middle, axis=0)
    moved = T_source_target.copy()
    moved[:, :3] = R_source @ moved[:, :3]
    moved[:, :3, :3] = moved[:, :3, :3] @ R_turned_camera[middle].T
    return moved

