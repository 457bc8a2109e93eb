"""Images of a scene are usable in any light, whatever they show; blank, noisy and frozen ones are detected."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest

from slam.frames import Frame, Image
from slam.frontend.image_gate import ImageGate
from slam.runtime.errors import Failed
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

QUALITIES = range(60, 90, 3)
STREET = 24  # frames
HAZARDS = [
    (),
    *(
        pytest.param(each, marks=pytest.mark.slow)
        for each in (("exposure", "blur"), ("rain", "moving-cars"))
    ),
]


@functools.cache
def street(hazards: tuple[str, ...] = ()) -> list[Image]:
    drive = SimulatedStreet(SimulationOptions("loop", 250, 704, 208, 64, hazards))
    return [drive.render(k) for k in range(40, 40 + STREET)]


def noise(seed: int) -> Image:
    return np.random.default_rng(seed).integers(0, 255, (64, 208, 3), np.uint8)


def frames_of(images: list[Image]) -> list[Frame]:
    return [Frame(k, 0.1 * k, image) for k, image in enumerate(images)]


def verdicts(images: list[Image]) -> list[str]:
    gate = ImageGate()
    return [v.reason if isinstance(v, Failed) else v for v in map(gate.check, frames_of(images))]


def jpeg(image: Image, quality: int) -> Image:
    """Re-encoded as JPEG."""
    _, coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)


@functools.cache
def wide() -> Image:
    """A wide image with structures of all sizes."""
    rng = np.random.default_rng(0)
    layers = [
        cv2.GaussianBlur(rng.normal(size=(64, 700)), (0, 0), sigma) for sigma in (1.0, 3.0, 20.0)
    ]
    grey = 128.0 + sum(
        weight * layer / layer.std()
        for weight, layer in zip((15.0, 15.0, 40.0), layers, strict=True)
    )
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def panned(positions_px: np.ndarray) -> list[Image]:
    """Images of a camera that moves along the wide image."""
    shifts = [np.float32([[1, 0, -position], [0, 1, 0]]) for position in positions_px]
    return [cv2.warpAffine(wide(), shift, (208, 64), flags=cv2.INTER_LINEAR) for shift in shifts]


@pytest.mark.parametrize("hazards", HAZARDS)
def test_a_drive_passes(hazards: tuple[str, ...]):
    assert set(verdicts(street(hazards))) == {"new"}


@pytest.mark.parametrize("level", [0, 255, 90])
def test_blank_images_with_a_little_noise_are_refused_and_the_drive_goes_on(level: int):
    dark = [
        np.clip(level + np.random.default_rng(k).normal(0, 1.5, (64, 208, 3)), 0, 255)
        for k in range(3)
    ]
    found = verdicts([*street()[:3], *(image.astype(np.uint8) for image in dark), *street()[20:23]])
    assert found == ["new"] * 3 + ["the image is blank"] * 3 + ["new"] * 3


def test_noise_is_refused_also_where_it_repeats():
    found = verdicts([*street()[:2], noise(0), noise(1), noise(1), *street()[5:8]])
    assert found == ["new"] * 2 + ["the image is noise"] * 3 + ["new"] * 3


def test_a_camera_that_turns_fast_and_another_scene_are_not_judged_here():
    """By half an image a frame, as a hand-held camera may, and by a cut to another place."""
    assert set(verdicts(panned(100.0 * np.arange(6)))) == {"new"}
    assert set(verdicts([*street()[:3], *panned(10.0 * np.arange(3))])) == {"new"}


def test_an_image_of_the_same_bytes_is_a_repetition():
    first, second = street()[:2]
    almost = second.copy()
    almost[0, 0, 0] ^= 1
    assert verdicts([first, second, second.copy(), second]) == [
        "new",
        "new",
        "repeated",
        "repeated",
    ]
    assert verdicts([first, almost, second]) == ["new", "new", "repeated"]  # a bit is no motion
    assert verdicts([second, almost]) == ["new", "new"]  # the camera has not moved yet


@pytest.mark.parametrize("hazards", HAZARDS)
@pytest.mark.parametrize("first", [3, 9])
def test_ten_re_encoded_copies_are_repetitions_and_the_drive_goes_on(
    hazards: tuple[str, ...], first: int
):
    images = street(hazards)
    copies = [jpeg(images[first], quality) for quality in QUALITIES]
    assert len(copies) == 10 and not any(np.array_equal(copy, images[first]) for copy in copies)
    found = verdicts([*images[: first + 1], *copies, *images[first + 11 :]])
    assert found == ["new"] * (first + 1) + ["repeated"] * 10 + ["new"] * (len(images) - first - 11)


def test_copies_are_detected_where_every_image_is_compressed():
    images = [jpeg(image, 75) for image in street()]
    frozen = [jpeg(street()[9], quality) for quality in QUALITIES]
    assert verdicts([*images[:10], *frozen, *images[20:]]) == ["new"] * 10 + ["repeated"] * 10 + [
        "new"
    ] * (STREET - 20)
    assert set(verdicts(images)) == {"new"}


def test_a_freeze_of_a_slow_camera_is_detected():
    """At two pixels a frame; the drive goes on where the camera is by then."""
    images = panned(2.0 * np.arange(40))
    frozen = [jpeg(images[9], quality) for quality in QUALITIES]
    assert (
        verdicts([*images[:10], *frozen, *images[20:]])
        == ["new"] * 10 + ["repeated"] * 10 + ["new"] * 20
    )


@pytest.mark.parametrize("braking_px", [0.2, 0.4])
def test_a_camera_that_slows_down_and_stops_is_not_frozen(braking_px: float):
    """Every frame is compressed separately, so that no two images of the standing camera have the same bytes."""
    speeds = np.concatenate(
        [np.full(8, 4.0), np.arange(4.0, 0.0, -braking_px), np.zeros(12), np.arange(0.0, 4.0, 0.5)]
    )
    images = panned(np.cumsum(speeds))
    rng = np.random.default_rng(0)
    noisy = [
        np.clip(image + rng.normal(0.0, 1.5, image.shape), 0, 255).astype(np.uint8)
        for image in images
    ]
    assert set(verdicts([jpeg(image, 60 + k % 28) for k, image in enumerate(noisy)])) == {"new"}


def test_a_simulated_stop_is_not_frozen():
    drive = SimulatedStreet(SimulationOptions("straight", 60, 704, 104, 32, ("stop",)))
    steps = np.linalg.norm(np.diff(drive.T_world_camera[:, :3, 3], axis=0), axis=1)
    assert (steps < 1e-9).sum() >= 10 and (steps > 0.5).sum() >= 10
    images = [jpeg(drive.render(k), 60 + k % 28) for k in range(60)]
    assert set(verdicts(images)) == {"new"}


@pytest.mark.data
@pytest.mark.parametrize("name", ["00", "02", "05"])
def test_freezes_are_detected_on_real_frames(data_root, name: str):
    folder = data_root / "kitti_odometry" / "sequences" / name / "image_0"
    images = [cv2.imread(str(path)) for path in sorted(folder.iterdir())[:60]]
    assert set(verdicts(images)) == {"new"}
    frozen = [*images[:20], *(jpeg(images[19], quality) for quality in QUALITIES), *images[30:]]
    assert verdicts(frozen) == ["new"] * 20 + ["repeated"] * 10 + ["new"] * 30
