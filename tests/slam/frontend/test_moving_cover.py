"""A wiper is seen where it moves over many images, and nowhere else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slam.frames import Frame, Image
from slam.frontend.image_gate import ImageGate
from slam.frontend.moving_cover import crossings
from slam.sequences.simulation.street import SimulatedStreet, SimulationOptions


def crossed(images: list[Image]) -> list[tuple[int, int]]:
    gate = ImageGate()
    for index, image in enumerate(images):
        gate.check(Frame(index, 0.1 * index, image))
    return crossings(gate.state().crossed)


def wiped(image: Image, k: int) -> Image:
    """A dark bar about a foot below the image."""
    height, width = image.shape[:2]
    angle = np.deg2rad(90 - 70 * np.cos(0.8 * k))
    tip = round(width / 2 + width * np.cos(angle)), round(1.2 * height - width * np.sin(angle))
    return np.asarray(
        cv2.line(image.copy(), (width // 2, round(1.2 * height)), tip, (30, 30, 30), width // 18), np.uint8
    )


def street(hazards: tuple[str, ...]) -> list[Image]:
    drive = SimulatedStreet(SimulationOptions("loop", 250, 704, 208, 64, hazards))
    return [drive.render(k).image for k in range(40, 80)]


def test_a_wiper_is_seen_as_long_as_it_moves() -> None:
    images = street(())
    assert crossed(images) == []
    ((first, last),) = crossed([wiped(image, k) if 10 <= k < 30 else image for k, image in enumerate(images)])
    assert 10 <= first <= 14 and 26 <= last <= 30
    assert crossed([wiped(image, 0) for image in images]) == []  # it rests


def test_hazards_of_the_road_are_none() -> None:
    assert crossed(street(("rain", "moving-cars", "exposure", "blur"))) == []


@pytest.mark.data
@pytest.mark.parametrize("name", ["00", "02", "05"])
def test_real_drives_have_none(data_root, name: str) -> None:
    folder = data_root / "kitti_odometry" / "sequences" / name / "image_0"
    assert crossed([cv2.imread(str(path)) for path in sorted(folder.iterdir())[::3]]) == []
