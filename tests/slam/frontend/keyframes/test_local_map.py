from __future__ import annotations

import numpy as np
import pytest

from slam.frames import Intrinsics
from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe
from slam.geometry.se3 import apply, invert

CAMERA = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
TRACKS, KNOWN = 60, 30


def seen(index: int, T_camera_world: np.ndarray, points: np.ndarray, noise_px: np.ndarray) -> TrackedKeyframe:
    x, y, z = apply(T_camera_world, points).T
    pixels = np.column_stack([500 * x / z + 319.5, 500 * y / z + 239.5]) + noise_px
    nothing = np.zeros((TRACKS, 32), np.uint8)
    depth = np.full(TRACKS, np.nan)
    return TrackedKeyframe(index, T_camera_world, np.arange(TRACKS), pixels, pixels, depth, nothing, None)


@pytest.mark.parametrize(("baseline_m", "least", "most"), [(0.02, 0, 0), (0.4, 25, 30)])
def test_points_need_cameras_apart(baseline_m: float, least: int, most: int) -> None:
    """Where a camera only turns, noise of the corners makes angles wide enough for points, all of them too near."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2, 2, (TRACKS, 2)), rng.uniform(4, 6, TRACKS)])
    T_world_second = np.eye(4)
    T_world_second[0, 3] = baseline_m
    local = LocalMap(points=points.copy())
    local.points[KNOWN:] = np.nan
    for index, T_world_camera in enumerate((np.eye(4), T_world_second)):
        local.add(seen(index, invert(T_world_camera), points, rng.normal(0, 2, (TRACKS, 2))))
    local.triangulate(CAMERA)
    found = np.isfinite(local.points[KNOWN:, 0])
    assert least <= found.sum() <= most
    np.testing.assert_allclose(local.points[KNOWN:][found, 2], points[KNOWN:][found, 2], rtol=0.3)
