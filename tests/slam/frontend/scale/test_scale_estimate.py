"""The scale of learned depth from ground planes over time, or from a reference."""

from __future__ import annotations

import numpy as np
import pytest

from slam.config.sections import ScaleConfig
from slam.frontend.scale.road_plane import GroundPlane
from slam.frontend.scale.scale_estimate import resolve_mode, scale_from_reference, scale_from_road, scale_track
from slam.runtime.errors import Failed

DOWN = np.array([0.0, 1.0, 0.0])


def planes_of(heights) -> list[GroundPlane | Failed]:
    return [GroundPlane(height, DOWN, 1.0) for height in heights]


def test_without_a_height_the_unit_is_the_camera_height():
    roads = planes_of([0.5] * 9)
    assert scale_from_road(roads).value == pytest.approx(2.0)
    assert scale_from_road(roads, 1.65).value == pytest.approx(3.3)


def test_too_few_frames_give_no_scale():
    failure = scale_from_road([*planes_of([0.5] * 3), *[Failed("dark")] * 30], 1.65)
    assert isinstance(failure, Failed) and "only 3 frames" in failure.reason


def test_the_scale_track_follows_a_drifting_unit_across_frames_without_a_plane():
    heights = np.where(np.arange(200) < 100, 0.50, 0.52)
    roads = planes_of(heights)
    roads[10:40] = [Failed("no road")] * 30
    estimate = scale_from_road(roads, 1.0)
    track = scale_track(roads, 1.0, estimate)
    assert track.shape == (200,)
    assert track[0] == pytest.approx(2.0)
    assert track[60] == pytest.approx(2.0)
    assert track[-1] == pytest.approx(1 / 0.52)


def test_reference_compares_the_first_path_lengths():
    true = np.tile(np.eye(4), (100, 1, 1))
    true[:, 2, 3] = np.arange(100)
    unscaled = true.copy()
    unscaled[:50, 2, 3] *= 0.25
    estimate = scale_from_reference(unscaled, true)
    assert estimate.value == pytest.approx(4.0)
    assert estimate.frames_used == 50
    assert isinstance(scale_from_reference(true * 0 + np.eye(4), true), Failed)


@pytest.mark.parametrize(
    ("configured", "height", "mode"),
    [
        ("auto", 1.65, "camera-height"),
        ("auto", None, "none"),
        ("none", 1.65, "none"),
        ("reference", None, "reference"),
        ("lidar", 1.65, "lidar"),
    ],
)
def test_auto_stands_for_camera_height_where_it_is_known(configured, height, mode):
    assert resolve_mode(ScaleConfig(mode=configured), height) == mode
