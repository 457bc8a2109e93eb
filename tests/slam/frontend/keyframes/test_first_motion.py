"""The first motion of a drawn scene with relief, and its reverse."""

from __future__ import annotations

import numpy as np
import pytest

from slam.frames import Intrinsics
from slam.frontend.keyframes.first_motion import first_motion
from slam.geometry.se3 import FloatArray, apply, from_rotation_vector, invert

CAMERA = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
T_WORLD_NOW = from_rotation_vector(np.array([0.0, 0.02, 0.01]), np.array([0.25, 0.02, 0.05]))


def views() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels in both views, and the depth in the first one: a near wall left of a far one."""
    rng = np.random.default_rng(2)
    pixels = rng.uniform((20, 20), (600, 440), (150, 2))
    depth = np.where(pixels[:, 0] < 300, 2.0, 4.0) * rng.uniform(0.95, 1.05, 150)
    now = apply(invert(T_WORLD_NOW), CAMERA.rays(pixels) * depth[:, None])
    return pixels, CAMERA.project(now) + rng.normal(0.0, 0.3, (150, 2)), depth


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_reverse_of_a_motion_is_left(sign: float):
    """Learned depth has no relief, and the first start may go the other way."""
    before, now, depth = views()
    start = np.eye(4)
    start[:3, 3] = -sign * T_WORLD_NOW[:3, 3]
    T, found = first_motion(start, before, now, np.full(150, 3.0), CAMERA)
    step = invert(T)[:3, 3]
    assert step @ T_WORLD_NOW[:3, 3] > 0.98 * np.linalg.norm(step) * np.linalg.norm(
        T_WORLD_NOW[:3, 3]
    )
    relief = np.median(found[depth > 3.0]) / np.median(found[depth < 3.0])
    assert relief == pytest.approx(2.0, rel=0.1)
    assert 1.5 < np.median(found) < 6.0
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
