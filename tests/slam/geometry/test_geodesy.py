"""The local frame against distances on the ellipsoid that are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from slam.geometry.geodesy import LocalFrame


@pytest.mark.parametrize("latitude", [-72.0, 0.0, 49.0, 89.9])
def test_there_and_back(latitude: float) -> None:
    frame = LocalFrame(np.array([latitude, 8.4, 115.0]))
    points = np.random.default_rng(0).normal(scale=[3e3, 3e3, 50.0], size=(50, 3))
    np.testing.assert_allclose(frame.points(frame.places(points)), points, atol=1e-6)
    np.testing.assert_allclose(frame.points(np.array([[latitude, 8.4, 115.0]])), 0.0, atol=1e-8)


def test_a_minute_of_arc_has_its_length() -> None:
    """At the equator a minute of longitude is a/3437.7 long; at the pole a minute of latitude a^2/b/3437.7."""
    minute = np.deg2rad(1 / 60)
    east = LocalFrame(np.array([0.0, 0.0, 0.0])).points(np.array([[0.0, 1 / 60, 0.0]]))[0]
    assert east[0] == pytest.approx(6378137.0 * minute, abs=1e-3) and east[1] == pytest.approx(0.0, abs=1e-9)
    north = LocalFrame(np.array([90.0, 0.0, 0.0])).points(np.array([[90.0 - 1 / 60, 180.0, 0.0]]))[0]
    assert np.hypot(north[0], north[1]) == pytest.approx(6378137.0**2 / 6356752.314245179 * minute, abs=1e-2)
