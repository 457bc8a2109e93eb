from dataclasses import replace

import numpy as np
import pytest

from slam.frames import Intrinsics
from slam.frontend.keyframes import bundle_adjustment
from slam.frontend.keyframes.bundle_adjustment import BundleAdjustment, Sightings
from slam.geometry.se3 import FloatArray, apply, from_rotation_vector, invert

INTRINSICS = Intrinsics(width=640, height=480, fx=500.0, fy=520.0, cx=320.0, cy=240.0)


def scene(
    cameras: int = 6, points: int = 60, noise_px: float = 0.0, depth_sigma: float = 0.0
) -> tuple[FloatArray, FloatArray, Sightings]:
    """Cameras on a walk, points before them, two thirds of all sightings, and depth by a prior of a third of these."""
    rng = np.random.default_rng(1)
    centres = np.cumsum(rng.normal(0.0, 0.15, (cameras, 3)), axis=0)
    T_camera_world = invert(from_rotation_vector(rng.normal(0.0, 0.1, (cameras, 3)), centres))
    X = rng.uniform((-2.0, -2.0, 3.0), (2.0, 2.0, 6.0), (points, 3))
    camera, point = (
        rows.ravel() for rows in np.meshgrid(range(cameras), range(points), indexing="ij")
    )
    seen = rng.random(len(camera)) < 2 / 3
    camera, point = camera[seen], point[seen]
    places = np.concatenate(
        [apply(T_camera_world[c], X[[p]]) for c, p in zip(camera, point, strict=True)]
    )
    pixels = places @ INTRINSICS.K.T
    noise = rng.normal(0.0, noise_px, (len(camera), 2))
    depth = np.where(
        rng.random(len(camera)) < 0.3, places[:, 2] * np.exp(rng.normal(0.0, depth_sigma)), np.nan
    )
    sigma = np.full(len(camera), 0.3)
    return (
        T_camera_world,
        X,
        Sightings(camera, point, pixels[:, :2] / pixels[:, 2:] + noise, depth, sigma),
    )


def disturbed(
    T_camera_world: FloatArray, X: FloatArray, fixed: int
) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(2)
    moved = T_camera_world.copy()
    small = from_rotation_vector(*rng.normal(0.0, 0.01, (2, len(moved) - fixed, 3)))
    moved[fixed:] = small @ moved[fixed:]
    return moved, X + rng.normal(0.0, 0.05, X.shape)


def test_jacobians_are_the_derivatives_of_the_residuals():
    """Those of depth without the unit of the image: they give the derivative of the cost nevertheless."""
    T, X, sightings = scene(depth_sigma=0.3)
    X = X + np.random.default_rng(4).normal(0.0, 0.1, X.shape)
    problem = BundleAdjustment(sightings, INTRINSICS, np.ones(len(T), np.bool_), robust=1e9)
    depth = problem.residuals(T, X)[:, 2]

    def check(derivatives: FloatArray, ahead: FloatArray, behind: FloatArray) -> None:
        numeric = (ahead - behind) / 2e-6
        np.testing.assert_allclose(derivatives[:2].T, numeric[:, :2], atol=1e-3)
        np.testing.assert_allclose(derivatives[2] @ depth, numeric[:, 2] @ depth, atol=1e-4)

    by_camera, by_point = problem.jacobians(T, X)
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        ahead, behind = (from_rotation_vector(s * step[:3], s * step[3:]) @ T for s in (1.0, -1.0))
        check(by_camera[axis], problem.residuals(ahead, X), problem.residuals(behind, X))
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        check(by_point[axis], problem.residuals(T, X + step), problem.residuals(T, X - step))


def test_finds_cameras_and_points_again():
    T, X, sightings = scene()
    free = np.arange(len(T)) >= 2
    problem = BundleAdjustment(sightings, INTRINSICS, free)
    solved = problem.solve(*disturbed(T, X, 2), iterations=30, tolerance=1e-12)
    np.testing.assert_allclose(solved.T_camera_world, T, atol=1e-6)
    twice = np.bincount(sightings.point, minlength=len(X)) > 1
    np.testing.assert_allclose(solved.points[twice], X[twice], atol=1e-5)
    assert solved.residual_px.max() < 1e-4


def test_is_the_least_squares_solution_and_leaves_fixed_cameras():
    T, X, sightings = scene(noise_px=0.5)
    free = np.arange(len(T)) >= 2
    problem = BundleAdjustment(sightings, INTRINSICS, free, robust=1e9)
    solved = problem.solve(*disturbed(T, X, 2), iterations=40, tolerance=1e-14)
    residual = problem.residuals(solved.T_camera_world, solved.points)
    by_camera, by_point = problem.jacobians(solved.T_camera_world, solved.points)
    gradient = np.zeros((len(X), 3))
    np.add.at(gradient, sightings.point, np.einsum("jis,si->sj", by_point, residual))
    assert np.abs(gradient).max() < 1e-3
    gradient_of_camera = np.zeros((len(T), 6))
    np.add.at(gradient_of_camera, sightings.camera, np.einsum("jis,si->sj", by_camera, residual))
    assert np.abs(gradient_of_camera[free]).max() < 1e-2
    np.testing.assert_array_equal(solved.T_camera_world[~free], T[~free])


def test_wrong_sightings_and_corners_in_a_reflection_move_little():
    """A quarter of the corners slides to the side."""
    T, X, sightings = scene(noise_px=0.7)
    free = np.arange(len(T)) >= 2
    pixels = sightings.pixels.copy()
    pixels[::20] += 100.0
    wrong = replace(sightings, pixels=pixels)
    reflected = sightings.point < len(X) // 4
    sliding = sightings.pixels.copy()
    sliding[reflected, 0] += 14.0 * np.maximum(sightings.camera[reflected] - 1, 0)
    mirror = replace(sightings, pixels=sliding)

    def error(wrong: Sightings, **noise: float) -> float:
        solved = BundleAdjustment(wrong, INTRINSICS, free, **noise).solve(T, X, 30, 1e-9)
        return float(np.linalg.norm(solved.T_camera_world[:, :3, 3] - T[:, :3, 3], axis=1).max())

    assert error(wrong) < 0.02 * error(wrong, robust=1e9)
    assert error(mirror) < 0.1 * error(mirror, robust=1e9)


def test_a_turn_has_depth_by_its_prior():
    """Where rays have no parallax, depths go to what they are by their prior to each other, and cameras turn."""
    _, X, sightings = scene()
    turns = np.column_stack([np.zeros(6), np.linspace(0.0, 0.1, 6), np.zeros(6)])
    T = invert(from_rotation_vector(turns, np.zeros((6, 3))))
    places = np.einsum("sij,sj->si", T[sightings.camera, :3, :3], X[sightings.point])
    pixels = places @ INTRINSICS.K.T
    turned = replace(sightings, pixels=pixels[:, :2] / pixels[:, 2:], depth=places[:, 2])
    problem = BundleAdjustment(turned, INTRINSICS, np.arange(6) > 0)
    start = X * np.random.default_rng(3).uniform(0.8, 1.25, (len(X), 1))
    solved = problem.solve(T, start, iterations=60, tolerance=1e-12)
    unit = np.median(solved.points[:, 2] / X[:, 2])
    np.testing.assert_allclose(solved.points, unit * X, rtol=1e-3)
    np.testing.assert_allclose(solved.T_camera_world, T, atol=1e-4)


@pytest.mark.parametrize("most_dense", [0, 900], ids=["sparse", "dense"])
def test_a_camera_that_sees_nothing_stays_and_the_others_are_found(
    most_dense: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(bundle_adjustment, "_MOST_DENSE", most_dense)
    T, X, sightings = scene(cameras=9, points=80)
    seen = sightings.camera != 5
    rest = Sightings(*(column[seen] for column in vars(sightings).values()))
    start, points = disturbed(T, X, 2)
    solved = BundleAdjustment(rest, INTRINSICS, np.arange(9) >= 2).solve(start, points, 30, 1e-12)
    others = np.arange(9) != 5
    np.testing.assert_allclose(solved.T_camera_world[others], T[others], atol=1e-4)
    np.testing.assert_allclose(solved.T_camera_world[5], start[5], atol=1e-9)
