import numpy as np

from slam.geometry.se3 import apply, from_rotation_vector, invert
from slam.loops.places import reprojection_errors, triangulate


def test_points_and_angles_of_exact_rays():
    rng = np.random.default_rng(0)
    X = rng.uniform((-1.0, -1.0, 3.0), (1.0, 1.0, 5.0), (8, 3))
    T = invert(
        from_rotation_vector(
            rng.normal(0.0, 0.1, (3, 3)), np.array([[0.0, 0, 0], [0.5, 0, 0], [0.0, 0.2, 0]])
        )
    )
    camera, point = (rows.ravel() for rows in np.meshgrid(range(3), range(8), indexing="ij"))
    rays = np.concatenate([apply(T[c], X[[p]]) for c, p in zip(camera, point, strict=True)])
    found, angle = triangulate(T[camera], rays / rays[:, 2:], point, 8)
    np.testing.assert_allclose(found, X, atol=1e-9)
    one = X[0] / np.linalg.norm(X[0])
    other = (X[0] - [0.5, 0, 0]) / np.linalg.norm(X[0] - [0.5, 0, 0])
    assert abs(angle[0] - np.arccos(one @ other)) < 1e-9


def test_parallel_rays_give_no_point():
    T = np.tile(np.eye(4), (2, 1, 1))
    found, angle = triangulate(T, np.array([[0.1, 0.0, 1.0]] * 2), np.zeros(2, np.int64), 1)
    assert np.isnan(found).all()
    assert angle[0] < 1e-6


def test_reprojection_errors_by_hand():
    points = np.array([[0.0, 0.0, 2.0], [1.0, 0.5, 2.0], [0.0, 0.0, -1.0]])
    rays = np.array([[0.0, 0.0, 1.0], [0.47, 0.29, 1.0], [0.0, 0.0, 1.0]])
    errors = reprojection_errors(np.tile(np.eye(4), (3, 1, 1)), points, rays, (100.0, 100.0))
    np.testing.assert_allclose(errors, [0.0, 5.0, np.inf])
