"""The scale by GPS fixes whose errors are large beside short tracks.

The local frame against distances on the ellipsoid that are known in closed form.
"""

from __future__ import annotations

import numpy as np
import pytest

from slam.config.sections import GpsConfig
from slam.frames import GpsTrack
from slam.frontend.gps import GpsFixes, LocalFrame
from slam.frontend.scale import ScaleEstimate
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import Failed

SPEED, HZ = 1.4, 10.0
CONFIG = GpsConfig()


def scale(positions: FloatArray, seed: int) -> ScaleEstimate | Failed:
    """Of an exact walk in metres, with a fix a second whose errors last as long as the configuration says."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(len(positions)) / HZ
    sigmas = np.array([CONFIG.sigma_m, CONFIG.sigma_m, CONFIG.vertical_sigma_m])
    seconds = np.arange(0.0, stamps[-1])
    errors = rng.normal(size=(len(seconds), 3)) * sigmas
    kept = np.exp(-1.0 / CONFIG.correlation_s)
    for k in range(1, len(errors)):
        errors[k] = kept * errors[k - 1] + np.sqrt(1.0 - kept**2) * errors[k]
    enu = np.column_stack([np.interp(seconds, stamps, positions[:, k]) for k in (0, 2, 1)]) * [
        1.0,
        1.0,
        -1.0,
    ]
    track = GpsTrack(
        seconds,
        LocalFrame(np.array([48.0, 11.0, 500.0])).places(enu + errors),
        np.ones(len(seconds)),
        np.full(len(seconds), np.nan),
    )
    T_world_camera = np.tile(np.eye(4), (len(positions), 1, 1))
    T_world_camera[:, :3, 3] = positions
    return GpsFixes(track, stamps, CONFIG).scale(T_world_camera)


def straight(length_m: float) -> FloatArray:
    way = np.arange(0.0, length_m, SPEED / HZ)
    return np.column_stack([0.3 * way, np.zeros_like(way), np.sqrt(1.0 - 0.09) * way])


def circles(radius_m: float, laps: int) -> FloatArray:
    """The last fixes of two laps are where the middle ones are."""
    turned = np.arange(0.0, 2.0 * np.pi * laps, SPEED / HZ / radius_m)
    return radius_m * np.column_stack([np.cos(turned), np.zeros_like(turned), np.sin(turned)])


@pytest.mark.parametrize(
    "walk", [straight(150.0), straight(300.0), circles(30.0, 2)], ids=["150 m", "300 m", "two laps"]
)
def test_errors_of_fixes_do_not_lengthen_the_scale(walk: FloatArray):
    found = [scale(walk, seed) for seed in range(12)]
    values = [each.value for each in found if isinstance(each, ScaleEstimate)]
    assert len(values) == 12
    assert np.mean(values) == pytest.approx(1.0, abs=0.025)


def test_a_track_under_the_documented_length_gives_no_scale():
    found = [scale(straight(112.0), seed) for seed in range(12)]
    assert all(isinstance(each, Failed) and "moves too little" in each.reason for each in found)


@pytest.mark.parametrize("latitude", [-72.0, 0.0, 49.0, 89.9])
def test_there_and_back(latitude: float):
    frame = LocalFrame(np.array([latitude, 8.4, 115.0]))
    points = np.random.default_rng(0).normal(scale=[3e3, 3e3, 50.0], size=(50, 3))
    np.testing.assert_allclose(frame.points(frame.places(points)), points, atol=1e-6)
    np.testing.assert_allclose(frame.points(np.array([[latitude, 8.4, 115.0]])), 0.0, atol=1e-8)


def test_a_minute_of_arc_has_its_length():
    """At the equator a minute of longitude is a/3437.7 long; at the pole a minute of latitude a^2/b/3437.7."""
    minute = np.deg2rad(1 / 60)
    east = LocalFrame(np.array([0.0, 0.0, 0.0])).points(np.array([[0.0, 1 / 60, 0.0]]))[0]
    assert east[0] == pytest.approx(6378137.0 * minute, abs=1e-3) and east[1] == pytest.approx(
        0.0, abs=1e-9
    )
    north = LocalFrame(np.array([90.0, 0.0, 0.0])).points(np.array([[90.0 - 1 / 60, 180.0, 0.0]]))[
        0
    ]
    assert np.hypot(north[0], north[1]) == pytest.approx(
        6378137.0**2 / 6356752.314245179 * minute, abs=1e-2
    )


def test_speeds_give_the_lengths_of_a_walk_too_short_for_fixes_without_heights():
    positions = 0.5 * straight(100.0)
    stamps = np.arange(len(positions)) / HZ
    seconds = np.arange(0.0, stamps[-1])
    places = np.column_stack(
        [np.full((len(seconds), 2), [48.0, 11.0]), np.full(len(seconds), np.nan)]
    )
    speeds = np.where(np.arange(len(seconds)) % 7 == 3, np.nan, 2 * SPEED)
    track = GpsTrack(seconds, places, np.ones(len(seconds)), speeds)
    T_world_camera = np.tile(np.eye(4), (len(positions), 1, 1))
    T_world_camera[:, :3, 3] = positions
    fixes = GpsFixes(track, stamps, CONFIG)
    found = fixes.scale(T_world_camera)
    assert isinstance(found, ScaleEstimate) and found.value == pytest.approx(4.0, rel=0.01)
    assert not fixes.has_heights and (fixes.sigmas[:, 2] > 10 * fixes.sigmas[:, 0]).all()
