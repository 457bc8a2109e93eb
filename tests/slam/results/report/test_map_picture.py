"""Pictures of a map show each colour where it stands."""

from __future__ import annotations

import numpy as np
import pytest

from slam.formats.ply import Ply
from slam.geometry.se3 import FloatArray
from slam.results.report.map_mesh import MapMesh
from slam.results.report.map_view import BACKGROUND, HEIGHT_PX, WIDTH_PX, MapScene


@pytest.fixture(scope="module")
def scene(plain: Ply) -> MapScene:
    assert plain.colours is not None and plain.triangles is not None
    return MapScene(MapMesh(plain.points, plain.colours, plain.triangles))


def facing(yaw_deg: float, z: float = 0.0) -> FloatArray:
    """A level camera at ``(0, 0, z)`` turned to the right."""
    T_world_camera = np.eye(4)
    s, c = np.sin(np.deg2rad(yaw_deg)), np.cos(np.deg2rad(yaw_deg))
    T_world_camera[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T_world_camera[2, 3] = z
    return T_world_camera


def test_from_above_a_place_has_its_colour(scene: MapScene) -> None:
    view = scene.from_above(np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]]))
    height, width = view.image.shape[:2]

    def at(x: float, z: float) -> list[int]:
        column = int((x - view.x[0]) / (view.x[1] - view.x[0]) * width)
        row = int((view.z[1] - z) / (view.z[1] - view.z[0]) * height)
        return [int(value) for value in view.image[row, column]]

    assert at(5.0, 5.0) == [204, 204, 178, 255]
    assert at(5.0, 15.0) == [51, 76, 51, 255]
    assert at(-15.0, 5.0) == [204, 204, 178, 255]
    assert at(95.0, 5.0)[3] == 0  # beside the map, but the drive goes there
    assert max(width, height) == 1100


def test_from_the_seat_the_ground_is_below_the_wall_ahead_and_the_sky_above(scene: MapScene) -> None:
    picture = scene.from_seat(facing(0.0))
    assert picture.shape == (HEIGHT_PX, WIDTH_PX, 3)
    assert tuple(picture[10, WIDTH_PX // 2]) == BACKGROUND
    assert picture[HEIGHT_PX // 2 - 40, WIDTH_PX // 2, 0] > 150 > 2 * picture[HEIGHT_PX // 2 - 40, WIDTH_PX // 2, 1]
    assert tuple(picture[-1, WIDTH_PX // 2 + 600]) == (204, 204, 178)  # 3.2 m ahead, 2.8 m to the right
    assert tuple(picture[-1, WIDTH_PX // 2 - 600]) == (51, 76, 51)
