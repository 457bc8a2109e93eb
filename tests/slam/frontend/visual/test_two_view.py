"""The motion between two views from corners, learned depth and the motion prior.

Residuals across and along epipolar lines, and their derivatives by finite differences. Which corners learned depth may
cast out as moving, and which weigh less because many were outliers recently.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from slam.frames import Frame, Intrinsics
from slam.frontend.visual.history import MotionHistory
from slam.frontend.visual.motion import Motion
from slam.frontend.visual.odometry import VisualOdometry
from slam.frontend.visual.two_view import (
    DEPTH_RELATIVE_SIGMA,
    INLIER_PX,
    Matches,
    Residuals,
    TwoViewEstimate,
    estimate,
    moving_corners,
    refined,
    tangent_of,
)
from slam.geometry import se3
from slam.geometry.multiview import UnitRelativePose, unit_pose_by_essential
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

FOCAL_PX = 240.0
CAR = 40
NO_HISTORY = MotionHistory()
LENGTH = 0.9
RNG = np.random.default_rng(0)
SCENE = RNG.uniform([0, 0], [1200, 370], (300, 2))
MOVING_CAR = RNG.uniform([600, 180], [700, 250], (20, 2))
PIXELS = np.concatenate([SCENE, MOVING_CAR])
OF_CAR = np.arange(len(PIXELS)) >= len(SCENE)
EXPECTED = np.concatenate([RNG.uniform(1, 15, len(SCENE)), np.full(len(MOVING_CAR), 8.0)])


def estimated(
    matches: Matches, history: MotionHistory = NO_HISTORY, seed: int = 0
) -> TwoViewEstimate:
    """The motion of one step after some history."""
    found = estimate(matches, history, seed)
    assert found is not None
    return found


def matches_of(previous: np.ndarray, current: np.ndarray, learned: np.ndarray) -> Matches:
    count = len(learned)
    sigma = np.full(count, DEPTH_RELATIVE_SIGMA)
    road, everyone = np.zeros(count, bool), np.ones(count, bool)
    return Matches(previous, current, learned, sigma, road, everyone, FOCAL_PX)


def corner_with_a_car(
    seed: int, turn_deg: float = 4.0, error: float = 0.15
) -> tuple[Matches, np.ndarray]:
    """``Matches`` of a camera that turns behind a car that turns with it, and the true ``T_current_previous``.

    The first ``CAR`` corners are the car's and stand still in the image; ``error`` is that of learned depth, relative.
    """
    rng = np.random.default_rng(seed)
    T_current_previous = se3.from_rotation_vector(
        np.deg2rad([0.0, -turn_deg, 0.0]), np.array([0.05, 0.0, -0.7])
    )
    world = np.column_stack([rng.uniform(-0.8, 0.8, 60), rng.uniform(-0.25, 0.05, 60), np.ones(60)])
    depth = rng.uniform(12.0, 40.0, 60)
    moved = se3.apply(T_current_previous, world * depth[:, None])
    car = np.column_stack(
        [rng.uniform(-0.12, 0.12, CAR), rng.uniform(-0.1, 0.15, CAR), np.ones(CAR)]
    )
    previous = np.concatenate([car, world])
    current = np.concatenate([car, moved / moved[:, 2:]])
    noise = rng.normal(0.0, 0.15 / FOCAL_PX, (2, len(previous), 2))
    previous[:, :2] += noise[0]
    current[:, :2] += noise[1]
    learned = np.concatenate([np.full(CAR, 10.0), depth]) * np.exp(
        error * rng.normal(size=len(previous))
    )
    return matches_of(previous, current, learned), T_current_previous


def angle_deg(R_a: np.ndarray, R_b: np.ndarray) -> float:
    return float(np.rad2deg(se3.rotation_angle(R_a.T @ R_b)))


def test_a_car_that_turns_with_the_camera_is_no_part_of_the_static_scene():
    """One step without history: RANSAC alone is wrong nearly always, the estimator in one of four cases."""
    by_essential, errors_deg, of_car, of_scene = [], [], [], []
    for seed in range(20):
        matches, T_current_previous = corner_with_a_car(seed)
        unit_pose = unit_pose_by_essential(
            matches.rays_previous, matches.rays_current, INLIER_PX / FOCAL_PX
        )
        two_view = estimated(matches)
        by_essential.append(angle_deg(unit_pose.R_current_previous, T_current_previous[:3, :3]))
        errors_deg.append(
            angle_deg(two_view.unit_pose.R_current_previous, T_current_previous[:3, :3])
        )
        of_car.append(two_view.inliers[:CAR].mean())
        of_scene.append(two_view.inliers[CAR:].mean())
    right = np.array(errors_deg) < 0.2
    assert np.median(by_essential) > 1.5
    assert right.mean() >= 0.7
    assert np.median(errors_deg) < 0.1
    assert np.array(of_car)[right].max() < 0.2
    assert np.array(of_scene)[right].min() > 0.7


def test_a_wrong_unit_and_unknown_depths_do_not_matter():
    matches, T_current_previous = corner_with_a_car(0)
    learned = 0.01 * matches.depth_previous
    learned[::7] = np.nan
    other = estimated(replace(matches, depth_previous=learned))
    assert angle_deg(other.unit_pose.R_current_previous, T_current_previous[:3, :3]) < 0.5


def test_a_known_motion_is_refined():
    matches, T_current_previous = corner_with_a_car(0, error=0.05)
    direction = T_current_previous[:3, 3] / np.linalg.norm(T_current_previous[:3, 3])
    off = se3.from_rotation_vector(np.deg2rad([0.05, 0.1, -0.05]), np.zeros(3))[:3, :3]
    start = UnitRelativePose(off @ T_current_previous[:3, :3], direction)
    found = refined(matches, start)
    assert angle_deg(found.unit_pose.R_current_previous, T_current_previous[:3, :3]) < 0.06


def test_the_history_of_a_drive_chooses_between_motions():
    """After twenty steps straight ahead a motion along the usual direction wins more often than without history."""
    history = NO_HISTORY
    for _ in range(20):
        ahead = UnitRelativePose(np.eye(3), np.array([0.07, 0.0, -1.0]) / np.hypot(0.07, 1.0))
        history = history.with_step(ahead, 0.9, 6.0)
    errors_deg = []
    for seed in range(20):
        matches, T_current_previous = corner_with_a_car(seed)
        for each in (NO_HISTORY, history):
            R = estimated(matches, each).unit_pose.R_current_previous
            errors_deg.append(angle_deg(R, T_current_previous[:3, :3]))
    without, with_history = np.reshape(errors_deg, (20, 2)).T
    assert (with_history < 0.3).sum() > (without < 0.3).sum() and (with_history < 0.3).mean() > 0.9


def test_without_common_points_there_is_no_motion():
    rng = np.random.default_rng(0)
    rays = [np.column_stack([rng.uniform(-0.8, 0.8, (12, 2)), np.ones(12)]) for _ in range(2)]
    matches = matches_of(*rays, np.full(12, np.nan))
    assert estimate(matches, NO_HISTORY) is None


@pytest.mark.slow
@pytest.mark.parametrize("first", [264])
def test_a_car_that_turns_off_in_rain_does_not_turn_the_camera(first):
    """Its corners are most of what blur and rain leave: an essential matrix by these is wrong by 4 degrees a frame."""
    hazards = ("moving-cars", "exposure", "blur", "stop", "rain")
    street = SimulatedStreet(SimulationOptions("loop", 400, 611, hazards=hazards))
    intrinsics = Intrinsics(416, 128, *street.K[[0, 1, 0, 1], [0, 1, 2, 2]])
    odometry = VisualOdometry(intrinsics)
    frames = [Frame(k, k / 10.0, street.render(k)) for k in range(first, first + 4)]
    for previous, current in itertools.pairwise(frames):
        depth = street.depth(previous.index)
        motion = odometry.measure(previous, current, depth, street.camera_height_m)
        assert isinstance(motion, Motion)
        T_world_camera = street.T_world_camera[[previous.index, current.index]]
        truth = se3.invert(T_world_camera[0]) @ T_world_camera[1]
        assert angle_deg(motion.relative_pose.T_from_to[:3, :3], truth[:3, :3]) < 0.5


def plain_road(seed: int, length: float = 0.9) -> tuple[Matches, np.ndarray, np.ndarray]:
    """Two thirds of the corners far, with learned depth 35 % too near; also which are near, and the true motion."""
    rng = np.random.default_rng(seed)
    T_current_previous = se3.from_rotation_vector(
        np.deg2rad(rng.normal(0.0, 0.3, 3)), np.array([0.0, 0.0, -length])
    )
    near = np.arange(600) < 200
    x, y = (
        rng.uniform(-0.8, 0.8, 600),
        np.where(near, rng.uniform(0.1, 0.25, 600), rng.uniform(-0.12, 0.02, 600)),
    )
    depth = np.where(near, 1.65 / np.maximum(y, 0.1), rng.uniform(40.0, 90.0, 600))
    previous = np.column_stack([x, y, np.ones(600)])
    current = se3.apply(T_current_previous, previous * depth[:, None])
    current /= current[:, 2:]
    current[:, :2] += rng.normal(0.0, 0.15 / 720.0, (600, 2))
    learned = depth * np.where(near, 1.0, 0.65) * np.exp(0.1 * rng.normal(size=600))
    return matches_of(previous, current, learned), near, T_current_previous


def test_learned_depth_that_sees_far_things_too_near_casts_out_no_near_corner():
    errors_deg, kept = [], []
    for seed in range(60):
        matches, near, T_current_previous = plain_road(seed)
        found = estimate(replace(matches, focal_px=720.0), NO_HISTORY)
        errors_deg.append(angle_deg(found.unit_pose.R_current_previous, T_current_previous[:3, :3]))
        kept.append(found.inliers[near].mean())
    assert max(errors_deg) < 0.1
    assert (
        min(kept) > 0.95
    )  # as many as have less than four sigmas of noise across their epipolar lines


@pytest.fixture
def unit_pose() -> UnitRelativePose:
    R = se3.from_rotation_vector(np.array([0.01, 0.06, 0.02]), np.zeros(3))[:3, :3]
    return UnitRelativePose(R, np.array([0.1, -0.05, -1.0]) / np.linalg.norm([0.1, -0.05, -1.0]))


def rays(seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matched rays ``(20, 3)``, far off their lines, and learned depths ``(20,)`` of which one is unknown."""
    rng = np.random.default_rng(seed)
    previous = np.column_stack([rng.uniform(-1.0, 1.0, (20, 2)), np.ones(20)])
    current = previous + np.column_stack([rng.normal(0.0, 0.2, (20, 2)), np.zeros(20)])
    return previous, current, np.concatenate([[np.nan], rng.uniform(4.0, 30.0, 19)])


def moved(unit_pose: UnitRelativePose, step: np.ndarray, tangent: np.ndarray) -> UnitRelativePose:
    slid = unit_pose.direction + tangent @ step[3:5]
    turned = se3.from_rotation_vector(step[:3], np.zeros(3))[:3, :3]
    return UnitRelativePose(turned @ unit_pose.R_current_previous, slid / np.linalg.norm(slid))


def test_across_is_the_sampson_distance_of_the_essential_matrix(unit_pose: UnitRelativePose):
    previous, current, depth = rays()
    E = np.cross(np.eye(3), unit_pose.direction).T @ unit_pose.R_current_previous
    expected = []
    for x, y in zip(previous, current, strict=True):
        gradient = np.concatenate([(E @ x)[:2], (E.T @ y)[:2]])
        expected.append(FOCAL_PX * (y @ E @ x) / np.linalg.norm(gradient))
    across, _ = Residuals(previous, current, depth, FOCAL_PX).across(
        unit_pose, tangent_of(unit_pose.direction)
    )
    np.testing.assert_allclose(np.abs(across), np.abs(expected), rtol=1e-9)
    assert len(set(np.sign(across) * np.sign(expected))) == 1


def test_along_is_the_distance_to_the_point_predicted_by_depth(unit_pose: UnitRelativePose):
    """Corners moved along their lines by what is then found; across them nothing counts."""
    previous, _, depth = rays()
    points = se3.apply(
        se3.make(unit_pose.R_current_previous, LENGTH * unit_pose.direction),
        previous * depth[:, None],
    )
    seen = points / points[:, 2:]
    turned = previous @ unit_pose.R_current_previous.T
    line = (seen - turned / turned[:, 2:])[:, :2]
    line /= np.linalg.norm(line, axis=1)[:, None]
    aside = np.linspace(-0.02, 0.02, 20)
    current = seen.copy()
    current[:, :2] += aside[:, None] * line + 0.01 * line[:, ::-1] * [1.0, -1.0]
    tangent = tangent_of(unit_pose.direction)
    along, _, shift_px = Residuals(previous, current, depth, FOCAL_PX).along(
        unit_pose, LENGTH, tangent
    )
    np.testing.assert_allclose(along[1:], -FOCAL_PX * aside[1:], atol=1e-9)
    expected = FOCAL_PX * np.linalg.norm((seen - turned / turned[:, 2:])[:, :2], axis=1)
    np.testing.assert_allclose(shift_px[1:], expected[1:], rtol=1e-9)


def test_derivatives_across_are_those_of_finite_differences(unit_pose: UnitRelativePose):
    """With corners far off their lines, where the change of the gradient's norm counts."""
    residuals, tangent = Residuals(*rays(), FOCAL_PX), tangent_of(unit_pose.direction)
    _, slopes = residuals.across(unit_pose, tangent)
    for k in range(5):
        step = 1e-6 * np.eye(5)[k]
        ahead, behind = (
            residuals.across(moved(unit_pose, sign * step, tangent), tangent)[0] for sign in (1, -1)
        )
        np.testing.assert_allclose((ahead - behind) / 2e-6, slopes[k], atol=1e-8 * FOCAL_PX)


def test_derivatives_along_are_those_of_finite_differences(unit_pose: UnitRelativePose):
    """Corners on their lines, where the rotation of the line has no effect; a corner of unknown depth is left out."""
    previous, _, depth = rays()
    points = se3.apply(
        se3.make(unit_pose.R_current_previous, LENGTH * unit_pose.direction),
        previous * depth[:, None],
    )
    residuals, tangent = (
        Residuals(previous, points / points[:, 2:], depth, FOCAL_PX),
        tangent_of(unit_pose.direction),
    )
    _, slopes, _ = residuals.along(unit_pose, LENGTH, tangent)
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        ahead, behind = (
            residuals.along(
                moved(unit_pose, sign * step, tangent), LENGTH + sign * step[5], tangent
            )[0]
            for sign in (1, -1)
        )
        np.testing.assert_allclose(
            ((ahead - behind) / 2e-6)[1:], slopes[k][1:], atol=1e-7 * FOCAL_PX
        )


@pytest.mark.parametrize(
    "direction",
    [
        [0.0, 0.0, -1.0],
        [0.0, 0.0, 1.0],
        [1.0, 0.0, 0.0],
        [0.0, -1.0, 0.0],
        [0.6, 0, -0.8],
        [0.6, -0.8, 0],
    ],
)
def test_a_tangent_and_its_direction_are_orthonormal(direction: list[float]):
    axes = np.column_stack([tangent_of(np.array(direction)), direction])
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)


def test_a_connected_region_of_one_motion_moves():
    seen = np.where(OF_CAR, 0.3 * EXPECTED, EXPECTED)
    moving = moving_corners(PIXELS, PIXELS[:, 1] > 300, ~OF_CAR, OF_CAR, EXPECTED, seen)
    np.testing.assert_array_equal(moving, OF_CAR)


def test_the_majority_of_the_parallax_does_not_move():
    """Learned depth agrees with the far corners, which are many: the near ones are the scene all the same."""
    near = PIXELS[:, 1] > 240
    expected = np.where(near, 8.0, 1.0)
    seen = np.where(near, 20.0, 1.0)
    moving = moving_corners(PIXELS, np.zeros(len(PIXELS), bool), ~near, near, expected, seen)
    assert not moving.any()


def test_the_majority_of_the_road_does_not_move():
    on_road = OF_CAR | (np.arange(len(PIXELS)) < 10)
    seen = np.where(OF_CAR, 0.3 * EXPECTED, EXPECTED)
    moving = moving_corners(PIXELS, on_road & OF_CAR, ~OF_CAR, OF_CAR, EXPECTED, seen)
    assert not moving.any()


def test_corners_that_contradict_each_other_do_not_move():
    seen = EXPECTED.copy()
    seen[OF_CAR] = EXPECTED[OF_CAR] * np.resize([0.3, 1.7], len(MOVING_CAR))
    moving = moving_corners(PIXELS, np.zeros(len(PIXELS), bool), ~OF_CAR, OF_CAR, EXPECTED, seen)
    assert not moving.any()
