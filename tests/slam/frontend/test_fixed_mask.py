"""What is fixed to the camera, found in images with truth: bonnets, captions, mirrors, and what is none of them."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest

from slam.frames import Grey, Mask, resized_mask
from slam.frontend.fixed_mask import FixedMask, warn_of_fixed
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

WIDTH, HEIGHT, FRAMES = 640, 192, 60
BONNET = 32  # rows
SEED = 700


@functools.cache
def street() -> list[Grey]:
    drive = SimulatedStreet(SimulationOptions("straight", FRAMES, SEED, WIDTH, HEIGHT))
    return [cv2.cvtColor(drive.render(k), cv2.COLOR_RGB2GRAY) for k in range(FRAMES)]


def with_bonnet(grey: Grey) -> Grey:
    """With a bonnet that reflects the mean of the scene and, blurred, the scene itself."""
    covered = grey.copy()
    reflected = cv2.GaussianBlur(grey[::-1], (0, 0), 4.0)[-BONNET:]
    covered[-BONNET:] = 20 + 0.2 * grey.mean() + 0.1 * reflected
    return covered


def with_caption(grey: Grey, k: int) -> Grey:
    """With white text in a black box, whose last digits change once a second."""
    covered = grey.copy()
    covered[:24, :240] = 0
    text = f"CAM 2 12:04:{k // 10:02d}"
    cv2.putText(covered, text, (6, 18), cv2.FONT_HERSHEY_PLAIN, 1.3, 255, 1)
    return covered


def with_mirror(grey: Grey, k: int) -> Grey:
    """With a mirror, in which the way back is seen."""
    covered = grey.copy()
    covered[3:45, 385:508] = cv2.resize(street()[FRAMES - 1 - k][:, ::-1], (123, 42))
    cv2.rectangle(covered, (385, 3), (508, 45), 10, 5)
    return covered


def found_in(images: list[Grey], given: Mask | None = None) -> Mask:
    """The mask ``(H, W)`` after a drive."""
    fixed = FixedMask()
    for image in images:
        fixed.look_at(image, given)
    none = np.zeros((1, 1), np.bool_)
    return resized_mask(none if fixed.mask is None else fixed.mask, WIDTH, HEIGHT)


def test_a_street_alone_has_hardly_anything_fixed():
    assert found_in(street()).mean() < 0.02


def test_a_bonnet_that_reflects_the_scene_is_found_and_the_road_before_it_stays():
    found = found_in([with_bonnet(image) for image in street()])
    assert found[-BONNET + 2 :].mean() > 0.97
    assert found[: -BONNET - 8].mean() < 0.02


def test_a_caption_is_found_though_its_digits_change():
    given = np.zeros((HEIGHT, WIDTH), np.bool_)
    given[-8:] = True
    found = found_in([with_caption(image, k) for k, image in enumerate(street())], given)
    assert found[6:18, 12:90].mean() > 0.6 and found[-6:].all()
    assert found[32:-8].mean() < 0.02


def test_the_frame_of_a_mirror_is_found_and_the_world_around_it_stays():
    found = found_in([with_mirror(image, k) for k, image in enumerate(street())])
    frame = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.rectangle(frame, (385, 3), (508, 45), 1, 5)
    assert found[frame > 0].mean() > 0.4
    found[:52, 378:516] = False
    assert found.mean() < 0.02


@pytest.mark.parametrize("passes", [False, True])
def test_a_camera_that_stands_learns_nothing(passes: bool):
    """With noise, and with a lorry all of texture that passes over less than half of the image."""
    rng = np.random.default_rng(SEED)
    lorry = cv2.resize(rng.integers(0, 255, (20, 40)).astype(np.uint8), (280, 150))
    images = []
    for k in range(FRAMES):
        image = street()[0].copy()
        left = 12 * k - 280
        if passes:
            shown = slice(max(left, 0), min(left + 280, WIDTH))
            image[30:180, shown] = lorry[:, shown.start - left : shown.stop - left]
        noisy = image + rng.normal(0.0, 2.0, image.shape)
        images.append(np.clip(noisy, 0, 255).astype(np.uint8))
    assert not found_in(images).any()


def test_another_size_begins_anew():
    fixed = FixedMask()
    for image in street():
        fixed.look_at(with_bonnet(image))
    assert fixed.mask is not None
    fixed.look_at(street()[0][:100, :310].copy())
    assert fixed.mask is None


@pytest.mark.parametrize(("rows", "said"), [(0, 0), (10, 1), (70, 2)])
def test_a_mask_that_leaves_little_of_the_world_is_said(
    rows: int, said: int, caplog: pytest.LogCaptureFixture
):
    fixed = np.zeros((100, 10), bool)
    fixed[:rows] = True
    warn_of_fixed(fixed)
    assert len(caplog.records) == said
    assert ("little of the world" in caplog.text) == (said == 2)
