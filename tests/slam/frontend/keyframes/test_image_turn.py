from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.frames import Grey, Intrinsics
from slam.frontend.keyframes.image_turn import (
    image_shift,
    image_turn,
    in_middle_row,
    measured_turn,
    small_image,
)
from slam.geometry.se3 import from_rotation_vector, rotation_angle

CAMERA = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)


def stripes(seed: int) -> Grey:
    """A bare wall: pale stripes without corners, and a shade."""
    y, x = np.mgrid[:480, :640]
    wide = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(1, 640)), (0, 0), 15)
    blotches = cv2.GaussianBlur(np.random.default_rng(seed + 1).normal(size=(480, 640)), (0, 0), 25)
    return np.asarray(120 + 0.05 * x + 60 * wide + 300 * blotches, np.uint8) + np.zeros_like(
        y, np.uint8
    )


def test_a_bare_wall_shows_how_the_camera_turned():
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


ROLLING = Intrinsics(320, 240, 290.0, 290.0, 159.5, 119.5, readout_s=0.03)
TURN = np.array([0.3, -0.8, 0.4])  # radians a second
PERIOD_S = 0.1


def seen(points: np.ndarray) -> np.ndarray:
    """Pixels of points, each at its row's moment, by a camera that turns steadily."""
    row = np.full(len(points), 119.5)
    for _ in range(10):
        seconds = ROLLING.readout_s * ((row + 0.5) / ROLLING.height - 0.5)
        pixels = ROLLING.project(Rotation.from_rotvec(seconds[:, None] * TURN).apply(points))
        row = pixels[:, 1]
    return pixels


@pytest.fixture
def points() -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.uniform((-1.2, -0.9, 4.0), (1.2, 0.9, 6.0), (60, 3))


def test_corners_are_moved_to_one_moment(points: np.ndarray):
    now = seen(points)
    truth = ROLLING.project(points)
    assert np.abs(now - truth).max() > 1.5
    before = ROLLING.project(Rotation.from_rotvec(-PERIOD_S * TURN).apply(points))
    turn = measured_turn(before, now.astype(np.float32), PERIOD_S, np.zeros(3), ROLLING)
    assert turn == pytest.approx(TURN, abs=0.005)
    assert np.abs(in_middle_row(now, turn, ROLLING) - truth).max() < 0.1


def test_without_a_readout_pixels_stay(points: np.ndarray):
    pixels = ROLLING.project(points)
    assert np.array_equal(in_middle_row(pixels, TURN, replace(ROLLING, readout_s=0.0)), pixels)
