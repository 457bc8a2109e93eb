"""Perspective-n-point: a known camera is found among outliers, its sigmas hold, and seeds vary the draws."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.geometry import se3
from slam.geometry.resection import consensus, ransac_order, refine
from slam.geometry.se3 import FloatArray

K = np.array([[240.0, 0.0, 160.0], [0.0, 240.0, 60.0], [0.0, 0.0, 1.0]])
T_CAMERA_POINTS = se3.from_rotation_vector(np.array([0.02, -0.05, 0.01]), np.array([0.1, -0.05, -0.8]))


def scene(seed: int, noise_px: float = 0.3, outliers: int = 30) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """100 points ``(100, 3)``, their pixels ``(100, 2)``, and which of them are inliers."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(4.0, 25.0, 100)
    points = np.column_stack([rng.uniform(-0.6, 0.6, 100), rng.uniform(-0.2, 0.2, 100), np.ones(100)]) * depth[:, None]
    seen = se3.apply(T_CAMERA_POINTS, points) @ K.T
    pixels = seen[:, :2] / seen[:, 2:] + noise_px * rng.normal(size=(100, 2))
    wrong = rng.permutation(100)[:outliers]
    pixels[wrong] += rng.choice([-1.0, 1.0], (outliers, 2)) * rng.uniform(20.0, 60.0, (outliers, 2))
    return points, pixels, ~np.isin(np.arange(100), wrong)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_camera_is_found_among_outliers_and_inliers_are_rows_of_the_points_given(seed: int) -> None:
    points, pixels, is_inlier = scene(5)
    found = consensus(points, pixels, K, 200, 2.0, seed)
    assert found is not None
    assert set(found[2]) <= set(np.flatnonzero(is_inlier)) and len(found[2]) > 60
    resection = refine(points, pixels, K, found)
    error = se3.invert(T_CAMERA_POINTS) @ resection.T_camera_points
    assert np.rad2deg(se3.rotation_angle(error[:3, :3])) < 0.1
    assert np.linalg.norm(error[:3, 3]) < 0.05
    np.testing.assert_array_equal(resection.inliers, found[2])


def test_pixels_without_a_common_camera_have_none() -> None:
    points, _, _ = scene(0)
    pixels = np.random.default_rng(1).uniform(0.0, 300.0, (100, 2))
    found = consensus(points, pixels, K, 200, 0.5)
    assert found is None or len(found[2]) < 12


def test_sigmas_are_those_of_the_errors_of_refined_cameras() -> None:
    whitened = []
    for seed in range(60):
        points, pixels, _ = scene(seed, noise_px=0.5, outliers=0)
        found = consensus(points, pixels, K, 200, 3.0)
        assert found is not None
        resection = refine(points, pixels, K, found)
        error = resection.T_camera_points @ se3.invert(T_CAMERA_POINTS)
        shift = resection.T_camera_points[:3, 3] - T_CAMERA_POINTS[:3, 3]
        turned = np.array([error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]]) / 2
        whitened.append(np.concatenate([turned, shift]) / resection.sigmas)
    rms = np.sqrt(np.square(whitened).mean(axis=0))
    assert (rms > 0.7).all() and (rms < 1.4).all(), rms


def test_an_order_is_a_permutation_by_its_seed() -> None:
    np.testing.assert_array_equal(ransac_order(50, 0), np.arange(50))
    one, same, other = ransac_order(50, 1), ransac_order(50, 1), ransac_order(50, 2)
    np.testing.assert_array_equal(one, same)
    assert (one != other).any() and (one != np.arange(50)).any()
    np.testing.assert_array_equal(np.sort(one), np.arange(50))
    assert len(ransac_order(0, 3)) == 0
