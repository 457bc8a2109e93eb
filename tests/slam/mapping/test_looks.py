"""Colours, exposure, holes of the road, and the shares of the filters."""

import numpy as np
import pytest

from slam.config.sections import MappingConfig
from slam.frames import Intrinsics
from slam.mapping import surface
from slam.mapping.depth import DepthFilters, KeyframeDepth
from slam.mapping.map import TsdfMap
from slam.mapping.submap import evened
from slam.mapping.surface import TileSurface, with_holes_closed


def test_exposure_is_evened_out(street_map):
    flat = street_map(grey=lambda k: 120.0, frames=12).mesh().colours / 255
    changing = (
        street_map(grey=lambda k: 120.0 * (1.5 if (k // 4) % 2 else 1.0), frames=12).mesh().colours
        / 255
    )
    assert flat.std() < 0.02
    assert changing.std() < 0.03  # 0.1 without it
    assert 0.4 < changing.mean() < 0.75


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
    mesh = tsdf_map.mesh()
    plate = mesh.colours[(np.abs(mesh.points[:, :2]) < 0.15).all(axis=1)]
    assert len(plate) and plate[:, 1].max() < 25


def test_brightness_steps_become_small_gains():
    steps = np.array([np.nan, 0.4, -0.4, np.nan, 0.2])
    brightness = evened(steps)
    np.testing.assert_allclose(np.diff(brightness)[[0, 1, 3]], [0.4, -0.4, 0.2], atol=0.01)
    np.testing.assert_allclose([brightness[:3].mean(), brightness[3:].mean()], 0, atol=0.01)
    assert len(evened(np.array([np.nan]))) == 1


def test_a_hole_of_the_road_is_closed_and_marked(street_map, monkeypatch):
    monkeypatch.setattr(surface, "_LEAST_WEIGHT", 2.0)
    whole = street_map(hidden=True, close_holes_m=4.0)
    mesh = whole.mesh()
    filled = mesh.vertices["filled"] > 0
    assert filled.sum() == 1
    np.testing.assert_allclose(mesh.points[filled][0], [0, 1.65, 20], atol=0.7)
    assert mesh.vertices["ny"][filled][0] < -0.99
    assert len(whole.cloud().points) == len(mesh.points) - 1
    assert not street_map(hidden=True, close_holes_m=1.5).mesh().vertices["filled"].any()


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
    sheet = TileSurface(vertices, triangles, np.ones(48, dtype=bool), np.zeros(48, dtype=bool))
    full = with_holes_closed(sheet, np.zeros(3, np.int64), 0.2, np.array(up), 1.5)
    assert len(full.vertices) - 36 == closed and full.filled.sum() == 4 * closed and full.own.all()
    np.testing.assert_allclose(full.vertices[36:], np.tile([1.5, 1.5, 1.0], (closed, 1)))
    normals = np.cross(
        *(full.vertices[full.triangles[:, k]] - full.vertices[full.triangles[:, 0]] for k in (1, 2))
    )
    assert (normals[:, 2] > 0).all()


def test_how_far_depth_is_fused_depends_on_its_sigma(monkeypatch):
    camera = Intrinsics(100, 50, 80.0, 80.0, 49.5, 24.5)
    depth = np.repeat(np.linspace(15, 40, 100, dtype=np.float32)[None], 50, axis=0)
    monkeypatch.setattr("slam.mapping.depth._MAX_DEPTH_STEP", 10.0)
    config = MappingConfig(depth_max_m=20)
    image = np.full((50, 100, 3), 90, np.uint8)

    def farthest(relative_sigma: np.ndarray | None) -> float:
        view = KeyframeDepth(0, depth, relative_sigma, image, np.eye(4))
        return float(DepthFilters(config, camera).kept(view, ()).max())

    assert 19 < farthest(None) < 20 and 19 < farthest(np.full_like(depth, 0.1)) < 20
    assert 23 < farthest(np.full_like(depth, 0.05)) <= 24  # 0.05 of 24 m is 1.2 m
    assert 27 < farthest(np.full_like(depth, 0.02)) < 28
