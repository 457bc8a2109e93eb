import numpy as np

from slam.frames import Intrinsics
from slam.frontend.keyframes.camera_pose import resect
from slam.geometry.projection import pixel_jacobian
from slam.geometry.se3 import FloatArray, apply, from_rotation_vector, invert, is_se3, rotation_angle

INTRINSICS = Intrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
T_TRUE = from_rotation_vector(np.array([0.1, -0.2, 0.3]), np.array([0.2, 0.1, -0.3]))


def seen(count: int = 80) -> tuple[FloatArray, FloatArray]:
    points = np.random.default_rng(0).uniform((-2.0, -1.5, 3.0), (2.0, 1.5, 6.0), (count, 3))
    homogeneous = apply(T_TRUE, points) @ INTRINSICS.K.T
    return points, homogeneous[:, :2] / homogeneous[:, 2:]


def test_jacobian_is_the_derivative_of_the_pixels() -> None:
    X = apply(T_TRUE, seen(10)[0])
    focal = np.array([500.0, 400.0])
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        ahead, behind = (apply(from_rotation_vector(s * step[:3], s * step[3:]), X) for s in (1.0, -1.0))
        numeric = (ahead[:, :2] / ahead[:, 2:] - behind[:, :2] / behind[:, 2:]) * focal / 2e-6
        np.testing.assert_allclose(pixel_jacobian(X, focal)[axis].T, numeric, atol=1e-4)


def test_finds_the_pose_from_a_far_guess() -> None:
    points, pixels = seen()
    pose = resect((np.eye(4),), points, pixels, INTRINSICS)
    np.testing.assert_allclose(pose.T_camera_world, T_TRUE, atol=1e-6)
    assert pose.residual_px.max() < 1e-3


def test_a_camera_that_moves_and_turns_steadily_stays_rigid() -> None:
    """Each pose begins at the one predicted by the last two, which fits."""
    rng = np.random.default_rng(1)
    T_step = from_rotation_vector(np.array([0.002, 0.02, 0.001]), np.array([0.01, 0.0, -0.03]))
    true = before = now = np.eye(4)
    for _ in range(1000):
        true = T_step @ true
        points = rng.uniform((-2.0, -1.5, 3.0), (2.0, 1.5, 6.0), (40, 3))
        predicted = now @ invert(before) @ now
        found = resect((predicted,), apply(invert(true), points), INTRINSICS.project(points), INTRINSICS)
        before, now = now, found.T_camera_world
    assert is_se3(now, tolerance=1e-12)
    assert rotation_angle(now[:3, :3] @ true[:3, :3].T) < 1e-6


def test_a_wrong_prediction_does_not_outweigh_the_last_pose() -> None:
    points, pixels = seen()
    pixels[:20] += 25.0
    wrong = from_rotation_vector(np.array([0.0, 0.8, 0.0]), np.array([1.0, 0.0, 0.0])) @ T_TRUE
    near = from_rotation_vector(np.array([0.0, 0.01, 0.0]), np.array([0.01, 0.0, 0.0])) @ T_TRUE
    pose = resect((near, wrong), points, pixels, INTRINSICS)
    np.testing.assert_allclose(pose.T_camera_world, T_TRUE, atol=1e-2)
    assert (pose.residual_px[20:] < 3.0).all()
    assert (pose.residual_px[:20] > 3.0).all()


def test_sigmas_are_of_the_size_of_the_errors() -> None:
    points, pixels = seen()
    rng = np.random.default_rng(3)
    errors, sigmas = [], []
    for _ in range(40):
        pose = resect((T_TRUE,), points, pixels + rng.normal(0.0, 0.5, pixels.shape), INTRINSICS)
        difference = pose.T_camera_world @ np.linalg.inv(T_TRUE)
        errors.append([rotation_angle(difference[:3, :3]), np.linalg.norm(difference[:3, 3])])
        sigmas.append([np.linalg.norm(pose.sigmas[:3]), np.linalg.norm(pose.sigmas[3:])])
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / np.mean(sigmas, axis=0)
    assert (ratio > 0.6).all()
    assert (ratio < 1.6).all()


def test_points_of_uncertain_depth_give_the_turn_and_only_the_direction_of_a_step() -> None:
    """All points at wrong depths: the pose is right, with what their parallax is off taken as their uncertainty."""
    points, pixels = seen(200)
    first = np.linalg.inv(T_TRUE)[:3, 3] + [0.2, 0.05, 0.0]
    factor = np.exp(np.random.default_rng(1).normal(0.0, 0.3, (200, 1)))
    wrong = first + factor * (points - first)
    exact = resect((T_TRUE,), wrong, pixels, INTRINSICS)
    known = resect((T_TRUE,), wrong, pixels, INTRINSICS, spread=0.3 * (wrong - first))

    def turned(T: FloatArray) -> float:
        return float(rotation_angle(T[:3, :3] @ T_TRUE[:3, :3].T))

    assert turned(known.T_camera_world) < 0.3 * turned(exact.T_camera_world)
    assert np.median(known.residual_px) < 0.5 * np.median(exact.residual_px)


def test_the_majority_is_not_the_world_where_others_have_the_vote() -> None:
    points, pixels = seen(200)
    trusted = np.arange(200) < 50
    T_moved = from_rotation_vector(np.array([0.0, 0.05, 0.0]), np.array([0.1, 0.0, 0.0])) @ T_TRUE
    moved = apply(T_moved, points) @ INTRINSICS.K.T
    pixels[~trusted] = (moved[:, :2] / moved[:, 2:])[~trusted]
    pose = resect((T_TRUE, T_moved), points, pixels, INTRINSICS, trusted=trusted)
    np.testing.assert_allclose(pose.T_camera_world, T_TRUE, atol=1e-6)
    assert (pose.residual_px[~trusted] > 3.0).all()
