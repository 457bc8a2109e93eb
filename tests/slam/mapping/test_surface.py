"""The surface of one tile."""

from __future__ import annotations

from collections import Counter
from itertools import permutations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slam.config.sections import MappingConfig
from slam.formats.ply import Ply
from slam.frames import Intrinsics
from slam.mapping import surface
from slam.mapping.depth import KeyframeDepth
from slam.mapping.map import TsdfMap
from slam.mapping.submap import BLOCK_SIDE, TILE_BLOCKS
from slam.mapping.surface import TileSurface, extract_tile, with_holes_closed


def test_the_order_of_vertices_in_one_place_is_that_of_their_triangles(
    monkeypatch: pytest.MonkeyPatch,
):
    """Open3D's threads give them in any; here two triangles touch in a corner that each has for itself."""
    vertices = np.array([[1, 1, 1], [2, 1, 1], [1, 2, 1], [1, 1, 1], [0.5, 1, 1], [1, 1, 0.5]])
    triangles = np.array([[0, 1, 2], [3, 4, 5]])
    submaps: Any = SimpleNamespace(merged=lambda low, high: ())
    found = []
    for order in permutations(range(6)):
        place = np.argsort(order)
        monkeypatch.setattr(
            surface, "_extract", lambda *_, o=order, p=place: (vertices[list(o)], p[triangles])
        )
        mesh = extract_tile(submaps, np.zeros(3, dtype=np.int64), 0.1)
        found.append((mesh.vertices, mesh.triangles))
    assert all(np.array_equal(v, found[0][0]) and np.array_equal(t, found[0][1]) for v, t in found)
    assert len({tuple(vertex) for vertex in found[0][0]}) == 5


@pytest.mark.slow
def test_tiles_are_joined_without_a_seam(street_map, monkeypatch):
    """The road crosses the border of tiles at x = 0; with voxels of 0.1 m another one lies at z = 25.6."""
    # a wall without noise that was seen once lies on voxels exactly, whose vertices coincide
    monkeypatch.setattr(surface, "_LEAST_TRIANGLES", 0)
    monkeypatch.setattr(surface, "_LEAST_WEIGHT", 2.0)
    whole = street_map(voxel_size_m=0.1).surface()
    vertices = Ply(np.concatenate(list(whole.vertex_pieces()))).points
    triangles = np.concatenate(list(whole.triangle_pieces()))
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


def test_a_view_without_depth_paints_nothing_right_before_it(monkeypatch):
    monkeypatch.setattr(surface, "_LEAST_TRIANGLES", 10)
    camera = Intrinsics(104, 64, 60.0, 60.0, 51.5, 31.5)
    x, y = np.moveaxis(camera.rays(camera.pixel_grid()), -1, 0)[:2]
    tsdf_map = TsdfMap(MappingConfig(), camera)
    for frame, z in enumerate(
        (0.0, 0.5, 1.0, 7.85, 8.35)
    ):  # a red plate at 8 m, unknown to the last two green views
        walls = 6 / np.maximum(np.abs(x), 0.01)
        is_plate = (np.abs(x) < 0.2) & (np.abs(y) < 0.2)
        depth = np.where(
            is_plate, 8.0 - z if z < 7 else 0.0, np.where(walls < 20, walls, 0.0)
        ).astype(np.float32)
        image = np.full((64, 104, 3), (200, 0, 0) if z < 7 else (0, 200, 0), np.uint8)
        T_world_camera = np.eye(4)
        T_world_camera[2, 3] = z
        tsdf_map.integrate(KeyframeDepth(frame, depth, None, image, T_world_camera))
    cloud = tsdf_map.cloud()
    plate = cloud.colours[(np.abs(cloud.points[:, :2]) < 0.15).all(axis=1)]
    assert len(plate) and plate[:, 1].max() < 25


def test_a_hole_of_the_road_is_closed_and_marked(street_map, monkeypatch):
    monkeypatch.setattr(surface, "_LEAST_WEIGHT", 2.0)
    whole = street_map(hidden=True, close_holes_m=4.0)
    vertices = np.concatenate(list(whole.surface().vertex_pieces()))
    filled = vertices["filled"] > 0
    assert filled.sum() == 1
    np.testing.assert_allclose(Ply(vertices[filled]).points[0], [0, 1.65, 20], atol=0.7)
    assert vertices["ny"][filled][0] < -0.99
    assert len(whole.cloud().points) == len(vertices) - 1
    smaller = street_map(hidden=True, close_holes_m=1.5).surface()
    assert smaller.points == smaller.vertices


@pytest.mark.parametrize(
    ("up", "closed"), [((0.0, 0.0, 1.0), 1), ((0.0, 0.0, -1.0), 0), ((1.0, 0.0, 0.0), 0)]
)
def test_only_holes_that_look_upwards_are_closed(up: tuple[float, float, float], closed: int):
    """A sheet of 5 x 5 squares that looks along z, without the one in the middle."""
    x, y = (each.ravel() for each in np.meshgrid(np.arange(6), np.arange(6), indexing="ij"))
    vertices = np.stack([x, y, np.zeros(36)], axis=1) * 0.2 + 1.0
    squares = [(i, j) for i in range(5) for j in range(5) if (i, j) != (2, 2)]
    corners = np.array(
        [[6 * i + j, 6 * (i + 1) + j, 6 * (i + 1) + j + 1, 6 * i + j + 1] for i, j in squares]
    )
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    sheet = TileSurface(vertices, triangles, np.ones(48, dtype=bool), 36)
    full = with_holes_closed(sheet, np.zeros(3, np.int64), 0.2, np.array(up), 1.5)
    assert len(full.vertices) - 36 == closed and len(full.triangles) - 48 == 4 * closed
    assert full.observed == 36 and full.own.all()
    np.testing.assert_allclose(full.vertices[36:], np.tile([1.5, 1.5, 1.0], (closed, 1)))
    normals = np.cross(
        *(full.vertices[full.triangles[:, k]] - full.vertices[full.triangles[:, 0]] for k in (1, 2))
    )
    assert (normals[:, 2] > 0).all()
