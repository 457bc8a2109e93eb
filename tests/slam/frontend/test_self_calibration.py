"""The camera of a recording that nobody calibrated, by its own images."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from erfsfm.common.readers.camera_file import UNKNOWN_FX_SIGMA
from slam.frames import Frame
from slam.frontend.self_calibration import find_camera
from slam.simulation.kitti_layout import simulated_world
from slam.simulation.options import SimulationOptions

WIDTH = 416
STREET = SimulationOptions(route="loop", frames=250, seed=11, width=WIDTH, height=128)


def images(options: SimulationOptions, first: int, last: int) -> Iterator[Frame]:
    street = simulated_world(options)
    for index in range(first, last):
        yield Frame(index, index / 10, street.render(index).image)


def test_a_street_that_turns_shows_its_focal_length() -> None:
    true_focal = simulated_world(STREET).camera.fx / (WIDTH / 2)
    found = find_camera(images(STREET, 40, 74))
    assert found.focal == pytest.approx(true_focal, rel=0.04)
    assert found.sigma < 0.05 and found.turn_deg > 20
    said = found.sentence(WIDTH)
    assert f"{found.focal * WIDTH / 2:.0f} px ± " in said and "(fov=8" in said


def test_a_straight_street_says_that_it_cannot_be_seen() -> None:
    straight = SimulationOptions(route="straight", frames=28, seed=11, width=WIDTH, height=128)
    found = find_camera(images(straight, 0, 28))
    assert found.sigma == UNKNOWN_FX_SIGMA
    assert "cannot be seen: the camera does not turn" in found.sentence(WIDTH)
    assert "fov=65 is taken" in found.sentence(WIDTH)
