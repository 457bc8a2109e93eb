"""An occupancy grid: free where the ground is seen, occupied where something stands on it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.commands.exports.ground import ground_along
from slam.commands.exports.sampling import Grid, samples
from slam.formats.ply import Ply
from slam.formats.ros_map import FREE, OCCUPIED, UNKNOWN
from slam.geometry.se3 import FloatArray

OBSTACLE_FROM_M, OBSTACLE_TO_M = 0.3, 2.5
_USUAL_CAMERA_HEIGHT_M = 1.65
_HOLE_M = 0.5  # gaps of the map in the road, up to this wide, are closed
_MIN_FREE_AREA, _MIN_OCCUPIED_AREA = 0.25, 0.5  # of a cell


@dataclass(frozen=True)
class OccupancyGrid:
    """Cells ``(H, W)``, largest y first; ``corner`` is x and y of the outer corner at the bottom left."""

    cells: NDArray[np.uint8]
    corner: tuple[float, float]
    resolution: float


def occupancy_grid(mesh: Ply, T_world_camera: FloatArray, resolution: float, is_metric: bool) -> OccupancyGrid:
    """Sort the surface of each cell by its height above the local ground.

    Args:
        mesh: x right, y ahead, z up.
        T_world_camera: poses of the drive ``(N, 4, 4)`` in the same axes.
        resolution: side of a cell.
        is_metric: whether lengths are metres; else they are camera heights.

    Raises:
        RunError: there is no ground below the cameras, or there are too many cells.
    """
    metre = 1.0 if is_metric else 1.0 / _USUAL_CAMERA_HEIGHT_M
    points = mesh.points
    ground = ground_along(points, T_world_camera, _USUAL_CAMERA_HEIGHT_M * metre)
    grid = Grid.around(points, resolution)
    free, occupied = np.zeros(grid.width * grid.height), np.zeros(grid.width * grid.height)
    for part in samples(mesh, grid):
        cells = grid.cells(part.points)
        touched, which = np.unique(cells, return_inverse=True)
        above = part.points[:, 2] - ground.heights(grid.centres(touched))[which]
        on_ground = np.abs(above) < OBSTACLE_FROM_M * metre
        standing = (above >= OBSTACLE_FROM_M * metre) & (above <= OBSTACLE_TO_M * metre)
        for areas, chosen in ((free, on_ground), (occupied, standing)):
            areas += np.bincount(cells[chosen], part.areas[chosen], len(areas))
    cell_area = resolution**2
    values = np.full(len(free), UNKNOWN, np.uint8)
    is_free = (free >= _MIN_FREE_AREA * cell_area).reshape(grid.shape)
    values = values.reshape(grid.shape)
    values[_without_small_holes(is_free, _HOLE_M * metre / resolution)] = FREE
    values[(occupied >= _MIN_OCCUPIED_AREA * cell_area).reshape(grid.shape)] = OCCUPIED
    return OccupancyGrid(values, (grid.x_min, grid.y_min), resolution)


def _without_small_holes(cells: NDArray[np.bool_], width: float) -> NDArray[np.bool_]:
    """The same with gaps closed that are narrower than so many cells."""
    side = int(width)
    if side < 2:
        return cells
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(cv2.morphologyEx(cells.astype(np.uint8), cv2.MORPH_CLOSE, element) > 0)
