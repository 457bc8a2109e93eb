"""The motion of a snippet is measured in its images, for any camera, and stays as guessed where they show nothing."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from erfsfm.checkpoint import Model, build_networks
from erfsfm.common.readers.camera_file import Pinhole
from erfsfm.config import NetworkConfig
from erfsfm.inference import DepthPosePredictor
from erfsfm.model_record import ModelRecord
from erfsfm.snippet_motion import LIKE_KITTI, Followed, followed, measured

Array = NDArray[np.float64]
KITTI = Pinhole(416, 128, 241.0, 245.0, 203.2, 62.7)
CAMERAS = [KITTI, Pinhole(416, 128, 500.0, 510.0, 205.0, 60.0), replace(KITTI, cx=150.0, cy=90.0)]
TRAVEL = np.array([0.03, -0.02, -1.0])  # translation of T_next_image: the camera moves ahead


def steady(turns_deg: Array, travel: Array) -> Array:
    """``T_image_target`` ``(5, 4, 4)`` of steps with these turns ``(4, 3)``, one travel in each camera halfway."""
    T = [np.eye(4)]
    for R in Rotation.from_rotvec(turns_deg, degrees=True).as_matrix():
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = R, (travel + R @ travel) / 2
        T.append(step @ T[-1])
    return np.stack(T) @ np.linalg.inv(T[2])


def sources(T_image_target: Array) -> Array:
    return np.delete(T_image_target, 2, axis=0)


def corners(
    T_image_target: Array, camera: Pinhole, seed: int = 0, noise: float = 0.0
) -> list[Followed]:
    """What images would show of 200 points at 5 to 60 m."""
    rng = np.random.default_rng(seed)
    f, c = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    steps = []
    for T_a_target, T_b_target in pairwise(T_image_target):
        before = rng.uniform((0, 0), (camera.width, camera.height), (200, 2))
        points = np.column_stack([(before - c) / f, np.ones(200)]) * rng.uniform(5, 60, (200, 1))
        T_b_a = T_b_target @ np.linalg.inv(T_a_target)
        moved = points @ T_b_a[:3, :3].T + T_b_a[:3, 3]
        after = moved[:, :2] / moved[:, 2:] * f + c + noise * rng.standard_normal((200, 2))
        steps.append(Followed(before, after, np.ones(200, bool)))
    return steps


def errors_deg(T: Array, true: Array) -> tuple[float, float]:
    """Largest error of a rotation, and of the direction of a translation."""
    turns = Rotation.from_matrix(T[:, :3, :3].swapaxes(1, 2) @ true[:, :3, :3]).magnitude()
    a, b = (
        each[:, :3, 3] / (np.linalg.norm(each[:, :3, 3], axis=1, keepdims=True) + 1e-12)
        for each in (T, true)
    )
    return float(np.degrees(turns).max()), float(
        np.degrees(np.arccos(np.clip((a * b).sum(axis=1), -1, 1))).max()
    )


TURNS = np.array([[0.1, -2.0, 0.1], [0.0, -1.5, 0.2], [0.2, 0.5, 0.0], [0.0, 1.0, -0.2]])


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_wrong_guess_is_mended_for_any_camera(camera: Pinhole):
    true = steady(TURNS, TRAVEL)
    guess = steady(0.3 * TURNS, TRAVEL + np.array([0.03, 0.02, 0.0]))  # two degrees aside
    turn, direction = errors_deg(
        measured(sources(guess), corners(true, camera, noise=0.1), camera), sources(true)
    )
    assert turn < 0.05 and direction < 0.3


def test_another_camera_is_another_motion():
    """What the constant camera of a network would make of it: turns by the quotient of the focal lengths."""
    true, steps = steady(TURNS, TRAVEL), corners(steady(TURNS, TRAVEL), CAMERAS[1])
    assert errors_deg(measured(sources(true), steps, KITTI), sources(true))[0] > 1


def test_corners_that_move_by_themselves_do_not_count():
    true, rng = steady(TURNS, TRAVEL), np.random.default_rng(1)
    steps = [
        each._replace(after=each.after + 8 * (rng.random((200, 1)) < 0.25))
        for each in corners(true, KITTI)
    ]
    turn, direction = errors_deg(
        measured(sources(steady(0.5 * TURNS, TRAVEL)), steps, KITTI), sources(true)
    )
    assert turn < 0.05 and direction < 0.3


def test_the_length_is_that_of_the_guess():
    true = steady(TURNS, TRAVEL)
    found = measured(sources(steady(TURNS, 0.1 * TRAVEL)), corners(true, KITTI), KITTI)
    np.testing.assert_allclose(found[:, :3, 3], 0.1 * sources(true)[:, :3, 3], atol=1e-3)


def test_without_corners_the_guess_stays():
    guess = steady(TURNS, TRAVEL)
    nothing = [each._replace(known=np.zeros(200, bool)) for each in corners(guess, KITTI)]
    np.testing.assert_allclose(measured(sources(guess), nothing, KITTI), sources(guess), atol=1e-9)


def test_a_camera_that_stands_keeps_the_guessed_direction():
    still = steady(np.zeros((4, 3)), np.zeros(3))
    turn, direction = errors_deg(
        measured(sources(steady(TURNS, TRAVEL)), corners(still, KITTI, noise=0.05), KITTI),
        sources(steady(np.zeros((4, 3)), TRAVEL)),
    )
    assert turn < 0.1 and direction < 2


def texture(seed: int) -> NDArray[np.uint8]:
    """Smooth noise ``(128, 416)``."""
    coarse = np.random.default_rng(seed).uniform(0, 255, (25, 83))
    return np.asarray(
        np.clip(cv2.resize(coarse, (416, 128), interpolation=cv2.INTER_CUBIC), 0, 255), np.uint8
    )


def turned(image: NDArray[np.uint8], R: Array, camera: Pinhole) -> NDArray[np.uint8]:
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    return np.asarray(
        cv2.warpPerspective(image, K @ R @ np.linalg.inv(K), (416, 128), flags=cv2.INTER_CUBIC),
        np.uint8,
    )


def seen(turns_deg: Array, camera: Pinhole, seed: int = 0) -> list[NDArray[np.uint8]]:
    """Grey images of a camera that turns on the spot."""
    T_image_target = steady(turns_deg, np.zeros(3))
    return [turned(texture(seed), T[:3, :3], camera) for T in T_image_target]


@pytest.mark.parametrize("seed", range(3))
def test_turns_that_nobody_guessed_are_found_in_images(seed: int):
    steps = [followed(a, b) for a, b in pairwise(seen(TURNS, KITTI, seed))]
    assert min(step.known.mean() for step in steps) > 0.5
    found = measured(np.tile(np.eye(4), (4, 1, 1)), steps, KITTI)
    assert errors_deg(found, sources(steady(TURNS, np.array([0, 0, -1e-9]))))[0] < 0.1
    assert np.abs(found[:, :3, 3]).max() == 0


def test_blank_images_have_no_corners():
    blank = np.full((128, 416), 90, np.uint8)
    assert not followed(blank, blank).known.any()


def test_a_predictor_measures_with_the_camera_of_the_images():
    config = NetworkConfig(depth_width=0.1, pose_width=0.1, alignment="images")
    networks = DepthPosePredictor.of(
        Model(ModelRecord(network=config, trained_on=[]), build_networks(config))
    )
    images = [np.repeat(each[..., None], 3, axis=2) for each in seen(TURNS, CAMERAS[1])]
    wanted = sources(steady(TURNS, TRAVEL))
    larger = CAMERAS[1].resized(832, 256)  # of the images before they were made smaller
    assert errors_deg(networks.poses(images, CAMERAS[1]), wanted)[0] < 0.1
    assert (
        errors_deg(networks.poses([networks.prepare(each) for each in images], larger), wanted)[0]
        < 0.1
    )
    as_kitti = networks.poses(images)
    assert errors_deg(as_kitti, wanted)[0] > 1
    np.testing.assert_allclose(
        as_kitti, networks.poses(images, LIKE_KITTI.resized(1241, 376)), atol=1e-9
    )
