from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.frames import Intrinsics
from slam.frontend.keyframes.image_turn import in_middle_row, measured_turn

CAMERA = Intrinsics(320, 240, 290.0, 290.0, 159.5, 119.5, readout_s=0.03)
TURN = np.array([0.3, -0.8, 0.4])  # radians a second
PERIOD_S = 0.1


def seen(points: np.ndarray) -> np.ndarray:
    """Pixels of points, each at its row's moment, by a camera that turns steadily."""
    row = np.full(len(points), 119.5)
    for _ in range(10):
        seconds = CAMERA.readout_s * ((row + 0.5) / CAMERA.height - 0.5)
        pixels = CAMERA.project(Rotation.from_rotvec(seconds[:, None] * TURN).apply(points))
        row = pixels[:, 1]
    return pixels


@pytest.fixture
def points() -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.uniform((-1.2, -0.9, 4.0), (1.2, 0.9, 6.0), (60, 3))


def test_corners_are_moved_to_one_moment(points: np.ndarray) -> None:
    now = seen(points)
    truth = CAMERA.project(points)
    assert np.abs(now - truth).max() > 1.5
    before = CAMERA.project(Rotation.from_rotvec(-PERIOD_S * TURN).apply(points))
    turn = measured_turn(before, now.astype(np.float32), PERIOD_S, np.zeros(3), CAMERA)
    assert turn == pytest.approx(TURN, abs=0.005)
    assert np.abs(in_middle_row(now, turn, CAMERA) - truth).max() < 0.1


def test_without_a_readout_pixels_stay(points: np.ndarray) -> None:
    pixels = CAMERA.project(points)
    assert np.array_equal(in_middle_row(pixels, TURN, replace(CAMERA, readout_s=0.0)), pixels)
