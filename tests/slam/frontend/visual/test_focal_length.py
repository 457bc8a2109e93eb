"""The focal length that corners show where the camera turns."""

from __future__ import annotations

import numpy as np
import pytest

from slam.frontend.visual.focal_length import FocalLength
from slam.geometry import se3
from slam.geometry.epipolar import UnitRelativePose

FOCAL_PX = 240.0


def shown(stated: float, turn_deg: float) -> FocalLength:
    """By twenty steps of corners with a noise of 0.1 px, their rays by a ``stated`` focal length."""
    rng, found = np.random.default_rng(0), FocalLength()
    for _ in range(20):
        T = se3.from_rotation_vector(np.deg2rad([0.2, turn_deg, 0.1]), np.array([0.1, -0.02, -0.9]))
        world = np.column_stack([rng.uniform(-0.8, 0.8, 200), rng.uniform(-0.3, 0.2, 200), np.ones(200)])
        moved = se3.apply(T, world * rng.uniform(4.0, 40.0, 200)[:, None])
        previous, current = world, moved / moved[:, 2:]
        current[:, :2] += rng.normal(0, 0.1, (200, 2)) / FOCAL_PX
        scale = np.array([FOCAL_PX / stated, FOCAL_PX / stated, 1.0])
        unit_pose, _ = UnitRelativePose.of(se3.invert(T))
        found = found.with_step(previous * scale, current * scale, unit_pose, stated)
    return found


@pytest.mark.parametrize("ratio", [0.96, 1.0, 1.04])
def test_a_camera_that_turns_shows_its_focal_length(ratio: float) -> None:
    logarithm, sigma = shown(FOCAL_PX / ratio, 3.0).error
    assert sigma < 0.06
    assert logarithm == pytest.approx(np.log(ratio), abs=0.01)


def test_a_camera_that_goes_straight_on_shows_little() -> None:
    _, straight = shown(FOCAL_PX, 0.0).error
    _, turning = shown(FOCAL_PX, 3.0).error
    assert straight > 5 * turning and FocalLength().error is None
