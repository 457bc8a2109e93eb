"""Submaps differ from one grid by rounding alone, and tiles leave no seam."""

from collections import Counter

import numpy as np
import pytest

from slam.mapping import surface
from slam.mapping.submap import BLOCK_SIDE, TILE_BLOCKS


def test_submaps_merge_to_the_surface_of_one(street_map, monkeypatch):
    one = street_map()
    monkeypatch.setattr("slam.mapping.map._SUBMAP_LENGTH", 3.0 / 20.0)
    many = street_map()
    assert one.statistics()["submaps"] == 1 and many.statistics()["submaps"] >= 5
    assert many.statistics()["frames_fused"] == 18 and many.statistics()["frames_left_out"] == 0
    a, b = one.mesh(), many.mesh()
    assert abs(len(a.triangles) - len(b.triangles)) < 0.01 * len(a.triangles)
    low, high = a.points.min(axis=0), a.points.max(axis=0)
    np.testing.assert_allclose([b.points.min(axis=0), b.points.max(axis=0)], [low, high], atol=0.01)
    distance = np.minimum(np.abs(b.points[:, 1] - 1.65), np.abs(np.abs(b.points[:, 0]) - 6))
    distance = np.minimum(distance, np.abs(b.points[:, 2] - 40))
    assert np.median(distance) < 0.01


@pytest.mark.slow
def test_little_memory_ends_a_submap_early_and_leaves_nothing_out(street_map):
    statistics = street_map(memory_mb=100, voxel_size_m=0.06).statistics()
    assert statistics["submaps"] > 1 and statistics["frames_fused"] == 18


@pytest.mark.slow
def test_tiles_are_joined_without_a_seam(street_map, monkeypatch):
    """The road crosses the border of tiles at x = 0; with voxels of 0.1 m another one lies at z = 25.6."""
    # a wall without noise that was seen once lies on voxels exactly, whose vertices coincide
    monkeypatch.setattr(surface, "_LEAST_TRIANGLES", 0)
    monkeypatch.setattr(surface, "_LEAST_WEIGHT", 2.0)
    mesh = street_map(voxel_size_m=0.1).mesh()
    vertices, triangles = mesh.points, mesh.triangles
    assert len(np.unique(vertices, axis=0)) == len(vertices)
    edges = Counter(
        map(tuple, np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).tolist())
    )
    assert max(edges.values()) == 2
    open_edges = np.array([edge for edge, count in edges.items() if count == 1])
    middle = vertices[open_edges].mean(axis=1)
    side = TILE_BLOCKS * BLOCK_SIDE * 0.1
    at_border = (np.abs(middle[:, 0]) < 0.2) | (np.abs(middle[:, 2] - side) < 0.2)
    inside = (
        (middle[:, 1] > 1.4)
        & (np.abs(middle[:, 0]) < 4)
        & (middle[:, 2] > 12)
        & (middle[:, 2] < 30)
    )
    assert not (at_border & inside).any()
    x = vertices[triangles][..., 0]
    left, right = triangles[x.min(axis=1) < 0], triangles[x.max(axis=1) > 0]
    assert len(np.intersect1d(left, right)) > 50
