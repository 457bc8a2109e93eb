from __future__ import annotations

import cv2
import numpy as np

from slam.frames import Grey, Intrinsics
from slam.frontend.keyframes.image_turn import image_shift, image_turn, small_image
from slam.geometry.se3 import from_rotation_vector, rotation_angle

CAMERA = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)


def stripes(seed: int) -> Grey:
    """A bare wall: pale stripes without corners, and a shade."""
    y, x = np.mgrid[:480, :640]
    wide = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(1, 640)), (0, 0), 15)
    blotches = cv2.GaussianBlur(np.random.default_rng(seed + 1).normal(size=(480, 640)), (0, 0), 25)
    return np.asarray(120 + 0.05 * x + 60 * wide + 300 * blotches, np.uint8) + np.zeros_like(y, np.uint8)


def test_a_bare_wall_shows_how_the_camera_turned() -> None:
    """Eleven degrees to the side and three about the view, brighter: only the turn before is known."""
    before = stripes(0)
    R = from_rotation_vector(np.deg2rad([2.0, 11.0, 3.0]), np.zeros(3))[:3, :3]
    H = CAMERA.K @ R @ np.linalg.inv(CAMERA.K)
    now = cv2.warpPerspective(before, H, (640, 480), borderMode=cv2.BORDER_REFLECT)
    first, second = small_image(before), small_image(cv2.convertScaleAbs(now, alpha=1.1, beta=10))
    R_guess = from_rotation_vector(np.deg2rad([0.0, 9.0, 0.0]), np.zeros(3))[:3, :3]
    turn = image_turn(first, second, R_guess, image_shift(first, second), CAMERA)
    assert np.rad2deg(rotation_angle(turn.R_now_before.T @ R)) < 0.3
    assert turn.correlation > 0.8
    other = small_image(stripes(7))
    assert image_turn(first, other, R_guess, image_shift(first, other), CAMERA).correlation < 0.7
