"""Submaps differ from one grid by rounding alone, and tiles leave no seam."""

import numpy as np
import pytest

from slam.mapping.submap import evened


def test_submaps_merge_to_the_surface_of_one(street_map, monkeypatch):
    one = street_map()
    monkeypatch.setattr("slam.mapping.map._SUBMAP_LENGTH", 3.0 / 20.0)
    many = street_map()
    assert one.statistics()["submaps"] == 1 and many.statistics()["submaps"] >= 5
    assert many.statistics()["frames_fused"] == 18 and many.statistics()["frames_left_out"] == 0
    triangles = [each.statistics()["triangles"] for each in (one, many)]
    assert abs(np.diff(triangles)) < 0.01 * triangles[0]
    a, b = one.cloud(), many.cloud()
    low, high = a.points.min(axis=0), a.points.max(axis=0)
    np.testing.assert_allclose([b.points.min(axis=0), b.points.max(axis=0)], [low, high], atol=0.01)
    distance = np.minimum(np.abs(b.points[:, 1] - 1.65), np.abs(np.abs(b.points[:, 0]) - 6))
    distance = np.minimum(distance, np.abs(b.points[:, 2] - 40))
    assert np.median(distance) < 0.01


@pytest.mark.slow
def test_little_memory_ends_a_submap_early_and_leaves_nothing_out(street_map):
    statistics = street_map(memory_mb=100, voxel_size_m=0.06).statistics()
    assert statistics["submaps"] > 1 and statistics["frames_fused"] == 18


def test_exposure_is_evened_out(street_map):
    flat = street_map(grey=lambda k: 120.0, frames=12).cloud().colours / 255
    changing = (
        street_map(grey=lambda k: 120.0 * (1.5 if (k // 4) % 2 else 1.0), frames=12).cloud().colours
        / 255
    )
    assert flat.std() < 0.02
    assert changing.std() < 0.03  # 0.1 without it
    assert 0.4 < changing.mean() < 0.75


def test_a_lens_that_darkens_its_corners_does_not_darken_the_end_of_a_map(street_map):
    """What comes nearer moves outwards and gets darker, from each view to the next."""
    cloud = street_map(grey=lambda k: 150.0, frames=30, darkening=-0.5).cloud()
    middle = np.median(cloud.colours)
    for end in (cloud.points[:, 2] < 8, cloud.points[:, 2] > 35):
        assert np.median(cloud.colours[end]) == pytest.approx(middle, rel=0.05)


def test_brightness_steps_become_small_gains():
    steps = np.array([np.nan, 0.4, -0.4, np.nan, 0.2])
    brightness = evened(steps)
    np.testing.assert_allclose(np.diff(brightness)[[0, 1, 3]], [0.4, -0.4, 0.2], atol=0.01)
    np.testing.assert_allclose([brightness[:3].mean(), brightness[3:].mean()], 0, atol=0.01)
    assert len(evened(np.array([np.nan]))) == 1
