"""Augmentation of a snippet: the camera is changed with the images."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.config import DataConfig
from erfsfm.data.augmentation import augment, rolled, weathered
from erfsfm.geometry import Camera

CAMERA = Camera(width=160, height=96, fx=110.0, fy=120.0, cx=77.0, cy=50.0)
POINTS = np.random.default_rng(2).uniform([-0.3, -0.15, 1.0], [0.3, 0.15, 1.5], (5, 3))


def project(camera: Camera, point: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, w = camera.K.astype(np.float64) @ point
    return np.array([x, y]) / w


def blob(centre: NDArray[np.float64]) -> NDArray[np.uint8]:
    """A white spot on black whose centre of gravity is ``centre``."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    spot = np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / 18)
    return np.repeat(np.rint(spot * 255).astype(np.uint8)[..., None], 3, axis=2)


def centre_of(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    grey = image[..., 0].astype(np.float64)
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(u * grey).sum(), (v * grey).sum()]) / grey.sum()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("flip", [0.0, 1.0])
@pytest.mark.parametrize("zoom", [1.0, 1.15, 1.3])
def test_points_project_to_where_the_augmented_image_has_them(seed, flip, zoom):
    images = [blob(project(CAMERA, point)) for point in POINTS]
    config = DataConfig(flip=flip, zoom=zoom)
    varied, _, camera, _ = augment(
        images, [], CAMERA, config, "default", np.random.default_rng(seed)
    )
    assert (camera.width, camera.height) == (160, 96)
    for image, point in zip(varied, POINTS):
        assert image.shape == (96, 160, 3)
        assert image.dtype == np.uint8
        seen = project(camera, point * [-1, 1, 1] if flip else point)
        np.testing.assert_allclose(centre_of(image), seen, atol=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_maps_move_with_the_images(seed):
    image = blob(project(CAMERA, POINTS[0]))
    values = image[..., 0].astype(np.float32)
    config = DataConfig(flip=0.5, zoom=1.3)
    (varied,), (moved,), _, _ = augment(
        [image], [values], CAMERA, config, "default", np.random.default_rng(seed)
    )
    assert set(np.unique(moved)) <= set(np.unique(values))  # never mixed
    v, u = np.mgrid[:96, :160]
    centre = np.array([(u * moved).sum(), (v * moved).sum()]) / moved.sum()
    np.testing.assert_allclose(centre, centre_of(varied), atol=0.25)


def test_a_rolled_camera_sees_points_where_it_should_at_the_same_depth():
    angle = np.deg2rad(3)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    for point in POINTS:
        depth = np.full((CAMERA.height, CAMERA.width), point[2], np.float32)
        image, (turned,) = rolled(blob(project(CAMERA, point)), [depth], CAMERA, angle, (0,))
        np.testing.assert_allclose(centre_of(image), project(CAMERA, turn @ point), atol=0.2)
        assert set(np.unique(turned)) == {np.float32(0), np.float32(point[2])}, (
            "unknown beyond the edges"
        )


def test_the_papers_flip_is_one_pixel_off():
    images = [blob(project(CAMERA, POINTS[0]))]
    varied, _, camera, _ = augment(
        images, [], CAMERA, DataConfig(flip=1, zoom=1), "paper", np.random.default_rng(0)
    )
    assert project(camera, POINTS[0] * [-1, 1, 1])[0] - centre_of(varied[0])[0] == pytest.approx(
        1, abs=0.05
    )


@pytest.mark.parametrize(("fidelity", "rounded"), [("default", True), ("paper", False)])
def test_the_papers_zoom_multiplies_the_camera_before_sizes_are_rounded(fidelity, rounded):
    images, config = [np.zeros((96, 160, 3), np.uint8)], DataConfig(flip=0, zoom=1.15)
    _, _, camera, _ = augment(images, [], CAMERA, config, fidelity, np.random.default_rng(7))
    sizes = np.array([160 * camera.fx / CAMERA.fx, 96 * camera.fy / CAMERA.fy])
    assert (np.abs(sizes - sizes.round()) < 1e-9).all() == rounded and (sizes > [160, 96]).all()


@pytest.mark.parametrize("seed", range(6))
def test_all_frames_get_the_same_colour_change(seed):
    rng = np.random.default_rng(9)
    image = rng.integers(0, 256, (96, 160, 3), dtype=np.uint8)
    config = DataConfig(flip=0, zoom=1, colour_jitter=0.3)
    (first, second), _, camera, _ = augment(
        [image, image.copy()], [], CAMERA, config, "default", np.random.default_rng(seed)
    )
    assert camera == CAMERA
    assert (first == second).all()
    assert (first != image).any()
    assert first.dtype == np.uint8


@pytest.fixture
def images() -> list[NDArray[np.uint8]]:
    v, u = np.mgrid[:64, :160]
    spot = np.exp(-((u - 79.5) ** 2 + (v - 31.5) ** 2) / 200)
    return [np.repeat(np.rint(60 + 150 * spot).astype(np.uint8)[..., None], 3, axis=2)] * 5


def test_only_the_seed_decides(images):
    first, again, other = (weathered(images, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert all(np.array_equal(a, b) for a, b in zip(first, again))
    assert any(not np.array_equal(a, b) for a, b in zip(first, other))


def test_images_stay_images_and_many_get_worse(images):
    changes = []
    for seed in range(40):
        seen = weathered(images, np.random.default_rng(seed))
        assert [image.shape for image in seen] == [(64, 160, 3)] * 5
        assert all(image.dtype == np.uint8 for image in seen)
        changes.append(np.mean([np.abs(image.astype(float) - images[0]).mean() for image in seen]))
    assert np.mean(np.array(changes) > 3) > 0.6
    assert max(changes) < 100


def test_positions_do_not_change(images):
    """The mean over much weather has its brightest place where the clear image has it."""
    seen = [
        image.astype(float)[..., 0]
        for s in range(60)
        for image in weathered(images, np.random.default_rng(s))
    ]
    bright = np.maximum(np.mean(seen, axis=0) - 90, 0)
    v, u = np.mgrid[:64, :160]
    assert (u * bright).sum() / bright.sum() == pytest.approx(79.5, abs=1.5)
    assert (v * bright).sum() / bright.sum() == pytest.approx(31.5, abs=1.5)
