"""Pictures of a street pass whatever their light; darkness, noise and repetition are told."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from slam.config import GapsConfig
from slam.frames import Image
from slam.frontend.failure import MeasurementFailure
from slam.frontend.image_gate import ImageGate
from slam.sequences.simulation.street import SimulatedStreet, SimulationOptions


@functools.cache
def street(hazards: tuple[str, ...] = ()) -> list[Image]:
    drive = SimulatedStreet(SimulationOptions("loop", 250, 704, 208, 64, hazards))
    return [drive.render(k).image for k in range(40, 70)]


def noise(seed: int) -> Image:
    return np.random.default_rng(seed).integers(0, 255, (64, 208, 3), np.uint8)


def verdicts(images: list[Image]) -> list[str]:
    gate = ImageGate(GapsConfig())
    return [v.reason if isinstance(v, MeasurementFailure) else v for v in map(gate.check, images)]


@pytest.mark.parametrize("hazards", [(), ("exposure", "blur"), ("rain", "moving-cars")])
def test_a_drive_passes(hazards: tuple[str, ...]) -> None:
    assert set(verdicts(street(hazards))) == {"new"}


@pytest.mark.parametrize("level", [0, 255, 90])
def test_blank_images_with_a_little_noise_are_refused_and_the_drive_goes_on(level: int) -> None:
    dark = [np.clip(level + np.random.default_rng(k).normal(0, 1.5, (64, 208, 3)), 0, 255) for k in range(3)]
    found = verdicts([*street()[:3], *(image.astype(np.uint8) for image in dark), *street()[20:23]])
    assert found == ["new"] * 3 + ["the image is blank"] * 3 + ["new"] * 3


def test_noise_is_refused_also_where_it_repeats() -> None:
    found = verdicts([*street()[:2], noise(0), noise(1), noise(1), *street()[5:8]])
    assert found == ["new"] * 2 + ["the image is noise"] * 3 + ["new"] * 3


def test_another_picture_is_damage_once_and_a_new_scene_twice() -> None:
    other = [image[:, ::-1][::-1] for image in street()]  # upside down: sky below, road above
    assert verdicts([*street()[:3], other[3], *street()[4:6]]) == [*["new"] * 3, UNLIKE, *["new"] * 2]
    assert verdicts([*street()[:3], *other[3:6]]) == [*["new"] * 3, UNLIKE, *["new"] * 2]


UNLIKE = "the image is unlike those before it"


def test_repetition_is_told_by_the_bytes() -> None:
    first, second = street()[:2]
    almost = second.copy()
    almost[0, 0, 0] ^= 1
    assert verdicts([first, second, second.copy(), second, almost]) == ["new", "new", "repeated", "repeated", "new"]
