"""The camera of a recording that nobody calibrated, by its own images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest

from erfsfm.common.readers.camera_file import UNKNOWN_FX_SIGMA
from slam.frames import Frame, Intrinsics
from slam.frontend.followed_corners import FollowedCorners, follow
from slam.frontend.self_calibration import (
    calibrated,
    check_camera,
    find_camera,
    joined,
    windows_that_turn,
)
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import simulated_world

WIDTH = 416
STREET = SimulationOptions(route="loop", frames=250, seed=11, width=WIDTH, height=128)


def images(options: SimulationOptions, first: int, last: int) -> Iterator[Frame]:
    street = simulated_world(options)
    for index in range(first, last):
        yield Frame(index, index / 10, street.render(index))


def test_a_street_that_turns_shows_its_focal_length():
    camera = simulated_world(STREET).camera
    wrong, seen = replace(camera, fx=1.25 * camera.fx), follow(images(STREET, 40, 74))
    rounds = np.arange(3)[:, None]
    keyframe, point = seen.keyframe + 30 * rounds, seen.point + len(seen) * rounds
    image = np.tile(seen.image, (3, 1))
    longer = FollowedCorners(keyframe.ravel(), point.ravel(), image, seen.pixel)
    assert check_camera(longer, wrong).sigmas_from(wrong) > 3.0
    assert check_camera(longer, camera).sigmas_from(camera) < 3.0
    assert check_camera(seen, wrong).sigma == UNKNOWN_FX_SIGMA  # it is too short
    found = joined(map(calibrated, windows_that_turn(seen)))
    assert found.focal == pytest.approx(camera.focal_half_widths, rel=0.04)
    assert found.sigma < 0.05 and found.turn_deg > 20
    said = found.sentence(WIDTH)
    assert f"{found.focal * WIDTH / 2:.0f} px ± " in said and "(fov=8" in said


@pytest.mark.slow
def test_a_straight_street_says_that_it_cannot_be_seen():
    found = find_camera(images(replace(STREET, route="straight"), 0, 28))
    assert found.sigma == UNKNOWN_FX_SIGMA
    said = found.sentence(WIDTH)
    assert "cannot be seen: the camera does not turn" in said and "fov=65 is taken" in said


@pytest.mark.slow
def test_a_lens_is_known_where_the_focal_length_is_not():
    """A straight street through a lens that draws corners in by an eighth; it bends the paths of the points."""
    straight = replace(STREET, route="straight", height=208)
    half, radial = WIDTH / 2, -0.12
    K = Intrinsics(WIDTH, 208, half, half, half - 0.5, 103.5).K
    pixels = np.mgrid[:208, :WIDTH][::-1].reshape(2, -1).T.astype(np.float64)
    ideal = cv2.undistortPoints(pixels, K, np.array([radial, 0.0, 0.0, 0.0]), P=K)
    columns_rows = ideal.reshape(208, WIDTH, 2).astype(np.float32)

    def bent() -> Iterator[Frame]:
        for frame in images(straight, 0, 40):
            image = cv2.remap(frame.image, columns_rows, None, cv2.INTER_LINEAR)
            yield replace(frame, image=np.asarray(image, np.uint8))

    found = find_camera(bent())
    assert found.sigma == UNKNOWN_FX_SIGMA
    first, second = found.radial[0] / found.focal**2, found.radial[1] / found.focal**4
    assert first + second == pytest.approx(radial, abs=0.05)
