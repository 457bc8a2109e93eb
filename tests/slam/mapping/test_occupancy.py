"""Free road, occupied walls and cars, unknown elsewhere, on a sloping street."""

from __future__ import annotations

import numpy as np
import pytest
from meshes import coloured_ply

from slam.formats.ply import Ply
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.mapping.occupancy import FREE, OCCUPIED, UNKNOWN, ground_along, occupancy_grid
from slam.runtime.errors import RunError

CAMERA_HEIGHT = 1.65
SLOPE, BANK = 0.06, 0.02
R_UP_CAMERA = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def road(x: FloatArray, y: FloatArray) -> FloatArray:
    """Height of the road: it climbs ahead after 20 m and falls to the right."""
    return SLOPE * np.clip(y - 20, 0, None) - BANK * x - CAMERA_HEIGHT


def sheet_of(points: FloatArray) -> Ply:
    """A grid of points ``(R, C, 3)`` as a mesh."""
    rows, columns = points.shape[:2]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    halves = [
        [corner, corner + 1, corner + columns],
        [corner + 1, corner + columns + 1, corner + columns],
    ]
    flat = points.reshape(-1, 3)
    shades = np.full(flat.shape, 0.5)
    triangles = np.concatenate([np.stack(half, axis=1) for half in halves])
    return coloured_ply(flat, np.zeros(flat.shape), shades, triangles)


def together(*meshes: Ply) -> Ply:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = [
        mesh.triangles + start for mesh, start in zip(meshes, starts) if mesh.triangles is not None
    ]
    return Ply(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles))


def standing(x: float, y: tuple[float, float], foot: float, top: float) -> Ply:
    """A wall along the street, from a height above the road to another."""
    along, up = np.meshgrid(np.arange(y[0], y[1], 0.2), np.arange(foot, top, 0.2), indexing="ij")
    across = np.full(along.shape, x)
    return sheet_of(np.stack([across, along, road(across, along) + up], axis=-1))


def level(x: tuple[float, float], y: tuple[float, float], above: float) -> Ply:
    across, along = np.meshgrid(
        np.arange(x[0], x[1], 0.2), np.arange(y[0], y[1], 0.2), indexing="ij"
    )
    return sheet_of(np.stack([across, along, road(across, along) + above], axis=-1))


@pytest.fixture
def street() -> tuple[Ply, FloatArray]:
    """A road with noise, a wall on the left, a kerb on the right, a low car roof, a canopy, and the poses."""
    ground = level((-7, 7), (-1, 60), 0.0)
    noise = np.random.default_rng(1).normal(0, 0.03, len(ground.vertices))
    ground.vertices["z"][:] = ground.vertices["z"] + noise
    parts = (
        standing(-8.5, (0, 60), 0.0, 6.0),
        level((5, 7), (0, 60), 0.15),
        level((2, 4), (30, 34), 1.4),
        level((-3, 3), (44, 48), 3.5),
    )
    y = np.arange(0, 55, 0.5)
    poses = np.stack([se3.make(R_UP_CAMERA, np.zeros(3)) for _ in y])
    poses[:, 1, 3], poses[:, 2, 3] = y, road(np.zeros_like(y), y) + CAMERA_HEIGHT
    return together(ground, *parts), poses


def test_the_ground_follows_slope_and_bank(street: tuple[Ply, FloatArray]):
    mesh, poses = street
    ground_at = ground_along(mesh.points, poses, 1.5)
    x, y = (each.ravel() for each in np.meshgrid([-6.0, 0.0, 6.0], [2.0, 10.0, 30.0, 50.0]))
    np.testing.assert_allclose(ground_at(np.stack([x, y], axis=1)), road(x, y), atol=0.12)
    assert np.isnan(ground_at(np.array([[40.0, 10.0]]))).all()


@pytest.mark.parametrize(("resolution", "unit"), [(0.1, 1.0), (0.25, 1 / CAMERA_HEIGHT)])
def test_what_is_free_and_what_is_occupied(
    street: tuple[Ply, FloatArray], resolution: float, unit: float
):
    mesh, poses = street
    vertices = mesh.vertices.copy()
    for axis in "xyz":
        vertices[axis] *= unit
    poses = poses.copy()
    poses[:, :3, 3] *= unit
    values, corner = occupancy_grid(
        Ply(vertices, mesh.triangles), poses, resolution * unit, unit == 1.0
    )
    shape, corner, step = values.shape, corner / unit, resolution

    def cells(x: tuple[float, float], y: tuple[float, float]) -> np.ndarray:
        first, last = (int((value - corner[0]) / step) for value in x)
        low, high = (shape[0] - 1 - int((value - corner[1]) / step) for value in y)
        return values[high : low + 1, first : last + 1]

    assert (cells((-6, 4), (1, 28)) == FREE).mean() > 0.99
    assert (cells((5.2, 6.8), (1, 50)) == FREE).mean() > 0.99  # the kerb
    assert (cells((2.2, 3.6), (30.2, 33.6)) == OCCUPIED).mean() > 0.99  # the car
    assert (cells((-2, 2), (45, 47)) == FREE).mean() > 0.99  # under the canopy
    assert (cells((-8.5, -8.5), (1, 50)) == OCCUPIED).mean() > 0.99  # the wall
    assert (cells((-7.9, -7.6), (1, 50)) == UNKNOWN).mean() > 0.9
    assert (values == OCCUPIED).sum() * step**2 == pytest.approx(2 * 4 + 60 * step, rel=0.15)


def test_narrow_gaps_of_the_road_are_closed_and_wide_ones_unknown(street: tuple[Ply, FloatArray]):
    _, poses = street
    parts = [level((-3, 3.2), along, 0.0) for along in ((-1, 10), (10.2, 20), (21.5, 60))]
    values, _ = occupancy_grid(together(*parts), poses, 0.1, True)
    # the last rows of the parts lie at 9.8, 19.8 and 59.8
    of_y = {
        y: values[len(values) - 1 - round((y + 1) / 0.1), 20:40] for y in (9.9, 10.1, 20.6, 30.0)
    }
    expected = {9.9: {FREE}, 10.1: {FREE}, 20.6: {UNKNOWN}, 30.0: {FREE}}
    assert {y: set(row.tolist()) for y, row in of_y.items()} == expected


def test_a_map_without_ground_is_refused(street: tuple[Ply, FloatArray]):
    _, poses = street
    with pytest.raises(RunError, match="no ground below the cameras"):
        occupancy_grid(level((-3, 3), (0, 50), 5.0), poses, 0.2, True)


def test_large_triangles_leave_no_holes(street: tuple[Ply, FloatArray]):
    """Two triangles from 20 m on; before them a vertex every 0.2 m, by which the ground is known."""
    corners = np.array([[-5, 20, 0], [5, 20, 0], [5, 60, 0], [-5, 60, 0]], float)
    corners[:, 2] = -CAMERA_HEIGHT
    floor = coloured_ply(
        corners, np.zeros((4, 3)), np.zeros((4, 3)), np.array([[0, 1, 2], [0, 2, 3]])
    )
    near = level((-5, 5.2), (-1, 20.2), 0.0)
    near.vertices["z"][:] = -CAMERA_HEIGHT
    poses = street[1].copy()
    poses[:, 2, 3] = 0.0
    values, _ = occupancy_grid(together(near, floor), poses, 0.07, True)
    rows = int(20 / 0.07)  # the ground is told as far as 12 camera heights from the last vertex
    assert (
        values[-(rows + 150) : -rows] == FREE
    ).mean() > 0.985  # the border cells are cut by the edge
