"""Depth refined by the network, on rendered scenes with exact poses: walls, a step, sky, a car ahead."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from erfsfm.mvs.fusion import DepthFusion
from erfsfm.mvs.refine import Measurement, RefinedDepth, measure
from erfsfm.mvs.views import Appearance

H, W = 96, 240
K = np.array([[150.0, 0.0, 119.5], [0.0, 150.0, 47.5], [0.0, 0.0, 1.0]])
V, U = np.mgrid[:H, :W].astype(np.float32)
X, Y = (U - K[0, 2]) / K[0, 0], (V - K[1, 2]) / K[1, 1]
POSITIONS = [(0.0, 0.0, -1.5), (0.2, 0.0, -0.6), (-0.2, 0.0, 0.6), (0.0, 0.0, 1.5)]
HEIGHT = 1.6
DECIDE = DepthFusion("default").decide


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).random((512, 512)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return np.clip(128 + (smooth - smooth.mean()) / smooth.std() * 45, 0, 255).astype(np.float32)


TEXTURES = [texture(seed) for seed in range(3)]


def painted(which: int, a: np.ndarray, b: np.ndarray, scale: float) -> np.ndarray:
    wrapped = [np.mod(c * scale, 512).astype(np.float32) for c in (a, b)]
    return cv2.remap(TEXTURES[which], *wrapped, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def wall_and_step(
    position: tuple[float, float, float], far: float = 12.0, left: float = -np.inf, right: float = 0
) -> tuple[np.ndarray, np.ndarray]:
    """A wall, and 6 m away a board in front of it, by default of its left half: image and depth."""
    x, y, z = position
    near_x, near_y = X * (6 - z) + x, Y * (6 - z) + y
    far_x, far_y = X * (far - z) + x, Y * (far - z) + y
    board = (near_x > left) & (near_x < right)
    image = np.where(board, painted(0, near_x, near_y, 40.0), painted(1, far_x, far_y, 240.0 / far))
    return image.astype(np.uint8), np.where(board, 6 - z, far - z).astype(np.float32)


def road_and_car(
    position: tuple[float, float, float], frame: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A road under a sky at infinity, and a car that keeps 8 m ahead: image, depth, mask of the car."""
    x, _, z = position
    car = (np.abs(X * 8) < 1.5) & (Y * 8 < HEIGHT) & (Y * 8 > -0.2)
    depth = np.where(Y > 0.01, HEIGHT / np.maximum(Y, 0.01), 1000.0)
    ground = painted(0, X * depth + x, depth + z, 20.0)
    sky = painted(1, X, Y, 400.0)
    image = np.where(car, painted(2, X * 8, Y * 8, 40.0), np.where(Y > 0.01, ground, sky))
    return image.astype(np.uint8), np.where(car, 8.0, depth).astype(np.float32), car


def measured(images: list[np.ndarray], prior: np.ndarray, unit: float = 1.0) -> Measurement:
    """What the others say of the first image at ``POSITIONS``; a metre is so many units."""
    T = np.tile(np.eye(4), (len(POSITIONS), 1, 1))
    T[:, :3, 3] = -unit * np.array(POSITIONS)
    target, *others = (Appearance.of(image) for image in images)
    return measure(target, (unit * prior).astype(np.float32), others, K, T)


def refined(images: list[np.ndarray], prior: np.ndarray, unit: float = 1.0) -> RefinedDepth:
    return DECIDE(measured(images, prior, unit))


def test_a_post_of_six_pixels_is_measured():
    views = [wall_and_step(p, left=-3.0, right=-2.76) for p in [(0.0, 0.0, 0.0), *POSITIONS]]
    found = measured([image for image, _ in views], np.full((H, W), 9.0))
    post = (found.depth * np.exp(-found.change))[views[0][1] < 7]
    assert (np.abs(post - 6) < 0.6).mean() > 0.9


def test_a_wall_and_a_step_are_found_from_a_wrong_guess():
    images = [wall_and_step(position)[0] for position in [(0.0, 0.0, 0.0), *POSITIONS]]
    truth = wall_and_step((0.0, 0.0, 0.0))[1]
    found = refined(images, np.full((H, W), 9.0))
    error = np.abs(found.depth - truth) / truth
    assert np.median(error) < 0.02
    assert (error < 0.1).mean() > 0.93
    step = np.abs(np.argmax(found.depth[10:-10] > 8.5, axis=1) - K[0, 2])
    assert np.median(step) <= 2.5, "the step lies where the image has it"


def test_sigma_is_honest():
    images = [wall_and_step(position)[0] for position in [(0.0, 0.0, 0.0), *POSITIONS]]
    noise = np.random.default_rng(0)
    noisy = [
        np.clip(image + noise.normal(0, 4, image.shape), 0, 255).astype(np.uint8)
        for image in images
    ]
    truth = wall_and_step((0.0, 0.0, 0.0))[1]
    found = refined(noisy, truth * 1.2)
    z = np.abs(np.log(found.depth / truth)) / found.relative_sigma
    assert (z < 1).mean() > 0.6
    assert (z < 2).mean() > 0.85


def test_without_texture_the_guess_stays_and_says_so():
    blank = [np.full((H, W), 120, np.uint8)] * (len(POSITIONS) + 1)
    prior = np.full((H, W), 9.0)
    found = refined(blank, prior)
    np.testing.assert_allclose(found.depth, prior, rtol=0.2)
    assert not found.measured.any()
    assert found.relative_sigma.min() >= 0.1


def test_what_no_neighbour_shows_is_not_measured():
    """As behind a fence, or under a leaf on the lens: the sigma is that of a guess."""
    images = [wall_and_step((0.0, 0.0, 0.0)), *(wall_and_step(position) for position in POSITIONS)]
    image, depth = images[0]
    image[20:60, 150:200] = painted(2, X * 3, Y * 3, 40.0)[20:60, 150:200]
    result = refined([each for each, _ in images], depth)
    hidden = np.zeros(depth.shape, bool)
    hidden[23:57, 153:197] = True
    assert result.measured[hidden].mean() < 0.05 < 0.5 < result.measured[~hidden].mean()


def test_sky_moves_away_from_a_near_guess():
    images = [road_and_car(p, k)[0] for k, p in enumerate([(0.0, 0.0, 0.0), *POSITIONS])]
    _, truth, car = road_and_car((0.0, 0.0, 0.0), 0)
    sky = (Y < -0.08) & ~car
    found = refined(images, np.where(sky, 60.0, truth))
    assert np.median(found.depth[sky]) > 75


@pytest.mark.parametrize("guess", [8.0, 9.0])
def test_a_car_that_drives_ahead_keeps_the_guess(guess: float):
    images = [road_and_car(p, k)[0] for k, p in enumerate([(0.0, 0.0, 0.0), *POSITIONS])]
    _, truth, car = road_and_car((0.0, 0.0, 0.0), 0)
    prior = np.where(car, guess, np.minimum(truth, 60.0))
    lower = car & (Y > 0.06) & (Y < 0.18)
    found = refined(images, prior)
    np.testing.assert_allclose(np.median(found.depth[lower]), guess, rtol=0.05)


def test_the_unit_of_length_does_not_matter():
    images = [wall_and_step(position)[0] for position in [(0.0, 0.0, 0.0), *POSITIONS]]
    metres, feet = (refined(images, np.full((H, W), 9.0), unit=unit) for unit in (1.0, 1 / 0.3048))
    np.testing.assert_allclose(np.median(feet.depth * 0.3048 / metres.depth), 1, atol=1e-4)
    np.testing.assert_allclose(feet.depth * 0.3048, metres.depth, rtol=0.02)
