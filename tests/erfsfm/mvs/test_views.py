from __future__ import annotations

import numpy as np

from erfsfm.mvs.views import Projection

K = np.array([[90.0, 0.0, 15.0], [0.0, 80.0, 9.0], [0.0, 0.0, 1.0]])


def a_motion() -> np.ndarray:
    T = np.eye(4)
    c, s = np.cos(0.1), np.sin(0.1)
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T[:3, 3] = [0.3, -0.1, 0.5]
    return T


def test_a_point_lands_where_the_camera_sees_it():
    T = a_motion()
    u, v, _ = Projection(K, T, 20, 30).pixels(np.full((20, 30), 1 / 4, np.float32))
    point = T[:3, :3] @ (4 * np.linalg.inv(K) @ [21.0, 7.0, 1.0]) + T[:3, 3]
    expected = (K @ point)[:2] / point[2]
    np.testing.assert_allclose([u[7, 21], v[7, 21]], expected, atol=1e-4)


def test_derivatives_are_those_of_small_differences():
    projection = Projection(K, a_motion(), 20, 30)
    inverse = np.full((20, 30), 0.2, np.float32)
    u, v, z = projection.pixels(inverse)
    du, dv = projection.motion(u, v, z, inverse)
    after, before = (projection.pixels(inverse * np.float32(np.exp(h))) for h in (0.01, -0.01))
    np.testing.assert_allclose(du, (after[0] - before[0]) / 0.02, atol=2e-2)
    np.testing.assert_allclose(dv, (after[1] - before[1]) / 0.02, atol=2e-2)
