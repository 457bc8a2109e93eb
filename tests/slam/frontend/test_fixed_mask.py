"""What is fixed to the camera is found while the world moves, and nothing of the world or of a camera that stands."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest

from slam.frames import Grey, Mask
from slam.frontend.fixed_mask import FixedMask
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

FRAMES = 60
WIDTH, HEIGHT = 416, 128


@functools.cache
def street() -> list[Grey]:
    drive = SimulatedStreet(SimulationOptions("straight", FRAMES, 621, WIDTH, HEIGHT))
    images = (drive.render(k).image for k in range(FRAMES))
    return [np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) for image in images]


def found_in(images: list[Grey]) -> FixedMask:
    mask = FixedMask()
    for grey in images:
        mask.look_at(grey)
    return mask


def full_size(mask: FixedMask) -> Mask:
    """``(H, W)``, empty where nothing was found."""
    if mask.mask is None:
        return np.zeros((HEIGHT, WIDTH), bool)
    sized = cv2.resize(mask.mask.view(np.uint8), (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
    return sized.astype(bool)


def with_bonnet(k: int, grey: Grey) -> tuple[Grey, Mask]:
    """The lowest fifth, an arc that reflects the mean of the scene and its blurred image upside down."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    bonnet = v > 0.8 * HEIGHT + 0.1 * HEIGHT * (2 * u / WIDTH - 1) ** 2
    reflected = 20 + 0.25 * grey.mean() + 0.12 * cv2.GaussianBlur(grey[::-1], (0, 0), 3)
    return np.where(bonnet, reflected, grey).astype(np.uint8), bonnet


def with_caption(k: int, grey: Grey) -> tuple[Grey, Mask]:
    """A bar with the time, whose last digit changes every ten frames; the truth is where any digit was."""
    covered, bar = grey.copy(), np.zeros((HEIGHT, WIDTH), bool)
    bar[4:24, 4:164] = True
    covered[bar] = 0
    text = f"12:04:{k // 10:02d}"
    cv2.putText(covered, text, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 255, 2, cv2.LINE_AA)
    return covered, bar


def with_mirror(k: int, grey: Grey) -> tuple[Grey, Mask]:
    """A dark frame, and in it the way back, turned round; the truth is the frame."""
    covered, frame = grey.copy(), np.zeros((HEIGHT, WIDTH), np.uint8)
    covered[2:30, 250:330] = cv2.resize(street()[FRAMES - 1 - k][:, ::-1], (80, 28))
    cv2.rectangle(frame, (250, 2), (330, 30), 1, 4)
    covered[frame > 0] = 10
    return covered, frame > 0


def test_a_clean_street_has_next_to_nothing_fixed() -> None:
    assert full_size(found_in(street())).mean() < 0.01


@pytest.mark.parametrize(
    ("cover", "recall"), [(with_bonnet, 0.8), (with_caption, 0.5), (with_mirror, 0.4)]
)
def test_most_of_what_is_fixed_is_found_and_hardly_any_of_the_world(cover, recall: float) -> None:
    covered = [cover(k, grey) for k, grey in enumerate(street())]
    found, truth = full_size(found_in([grey for grey, _ in covered])), covered[0][1]
    # corners beside an edge see it, and what the mirror shows is not the world before the camera
    beside = cv2.dilate(truth.astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
    if cover is with_mirror:
        beside[:34, 244:336] = True
    assert (found & truth).sum() > recall * truth.sum()
    assert (found & ~beside).mean() < 0.01


@pytest.mark.parametrize("has_lorry", [False, True])
def test_a_camera_that_stands_learns_nothing(has_lorry: bool) -> None:
    """Also while a lorry passes over 45 % of its image; every image has noise of its own."""
    rng = np.random.default_rng(0)
    lorry = rng.integers(0, 255, (HEIGHT, 45 * WIDTH // 100)).astype(np.float32)
    lorry = 128 + 4 * (cv2.GaussianBlur(lorry, (0, 0), 2.0) - 128)
    images = []
    for k in range(FRAMES):
        image = street()[0] + rng.normal(0, 2.0, (HEIGHT, WIDTH))
        if has_lorry:
            place = max(0, min(WIDTH, 12 * k) - lorry.shape[1])
            image[:, place : place + lorry.shape[1]] = np.roll(lorry, 12 * k, axis=1)
        images.append(np.clip(image, 0, 255).astype(np.uint8))
    assert found_in(images).mask is None


def panned(step_px: float) -> list[Grey]:
    """Images of a camera that moves along a wide image."""
    rng = np.random.default_rng(0)
    wide = np.zeros((64, 700))
    for weight, sigma in ((15.0, 1.0), (15.0, 3.0), (40.0, 20.0)):
        layer = cv2.GaussianBlur(rng.normal(size=wide.shape), (0, 0), sigma)
        wide += weight * layer / layer.std()
    grey = np.clip(128 + wide, 0, 255).astype(np.uint8)
    shifts = [np.float32([[1, 0, -step_px * k], [0, 1, 0]]) for k in range(40)]
    return [cv2.warpAffine(grey, shift, (208, 64), flags=cv2.INTER_LINEAR) for shift in shifts]


def test_pixels_that_stand_while_the_camera_moves_are_found() -> None:
    """A textured bonnet, not a band of the scene, and nothing of a camera that stands."""
    bonnet = np.random.default_rng(0).integers(0, 255, (16, 208)).astype(np.uint8)
    images = panned(3.0)
    covered = [np.concatenate([image[:48], bonnet]) for image in images]
    still = [
        cv2.imdecode(cv2.imencode(".jpg", images[0], [cv2.IMWRITE_JPEG_QUALITY, 60 + k])[1], 0)
        for k in range(40)
    ]
    assert found_in(images).mask is None and found_in(still).mask is None
    found = found_in(covered).mask
    assert found is not None and found[52:].mean() > 0.9 and not found[:40].any()
