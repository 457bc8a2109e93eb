"""An occupancy grid for ROS: free where the ground along a drive is seen, occupied where something stands on it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slam.formats.ply import Ply
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray, IntArray
from slam.mapping.submap import moved_rows
from slam.runtime.errors import RunError
from slam.runtime.files import write_atomically

FREE, OCCUPIED, UNKNOWN = 254, 0, 205
_THRESHOLDS = {"occupied_thresh": 0.65, "free_thresh": 0.196}
OBSTACLE_FROM_M, OBSTACLE_TO_M = 0.3, 2.5
_USUAL_CAMERA_HEIGHT_M = 1.65
_HOLE_M = 0.5  # gaps of the map in the road, up to this wide, are closed
_MIN_FREE_AREA, _MIN_OCCUPIED_AREA = 0.25, 0.5  # of a cell
_SAMPLES_A_CELL = 4.0
_CHUNK = 250_000  # triangles at a time
_MOST_CELLS = 64_000_000
_BORDER_DECIMALS = 6
# steps of Roberts' R2 sequence, which fills a square
_EVENLY = np.array([0.7548776662466927, 0.5698402909980532])

# of its ground, in camera heights
_ANCHOR_STEP = 0.6
_RADIUS = 3.5
_NEAREST, _FURTHEST = 0.4, 2.5  # a road lies so far below the camera
_BAND = 0.3  # around it, surface of the road and kerbs
_REACH = 12.0
_MIN_POINTS = 30
_LEAST_SQUARES_ROUNDS = 6
_TUKEY = 0.12
# weight of the camera's own tilt, against one of a point at the edge of the neighbourhood
_TILT_PRIOR = 0.05
_NEIGHBOURS = 6


@dataclass(frozen=True)
class Grid:
    """Square cells of the x-y plane, row by row from the smallest y; ``first`` ``(2,)`` counts from the origin."""

    first: FloatArray
    width: int
    height: int
    resolution: float

    @classmethod
    def around(cls, points: FloatArray, resolution: float) -> Grid:
        """The cells that points ``(P, 3)`` lie in; their borders are multiples of ``resolution``.

        Args:
            points: ``(P, 3)``, of which x and y count.
            resolution: the side of a cell, in the unit of the points.

        Raises:
            RunError: it would have too many cells.
        """
        # rounded, so that an edge on a border of cells does not begin another row
        low = np.floor((points[:, :2].min(axis=0) / resolution).round(_BORDER_DECIMALS))
        high = np.ceil((points[:, :2].max(axis=0) / resolution).round(_BORDER_DECIMALS))
        width, height = (int(size) for size in np.maximum(high - low, 1.0))
        if width * height > _MOST_CELLS:
            raise RunError(
                f"--resolution {resolution:g} gives {width} x {height} cells, more than {_MOST_CELLS:,}: "
                "give a larger one"
            )
        return cls(low, width, height, resolution)

    @property
    def corner(self) -> FloatArray:
        """Smallest x and y ``(2,)``."""
        return (self.first * self.resolution).round(9)

    def cells(self, points: FloatArray) -> IntArray:
        """Flat numbers ``(P,)`` of the cells of points ``(P, 2 or 3)``."""
        places = np.floor(points[:, :2] / self.resolution - self.first)
        column, row = np.clip(places, 0, [self.width - 1, self.height - 1]).astype(np.int64).T
        return row * self.width + column

    def centres(self, cells: IntArray) -> FloatArray:
        """Centres ``(C, 2)`` of cells by their flat numbers."""
        row, column = np.divmod(cells, self.width)
        return (self.first + 0.5 + np.stack([column, row], axis=1)) * self.resolution


def occupancy_grid(
    mesh: Ply, T_world_camera: FloatArray, resolution: float, is_metric: bool
) -> tuple[NDArray[np.uint8], FloatArray]:
    """Sort the surface of each cell by its height above the local ground.

    Args:
        mesh: x right, y ahead, z up.
        T_world_camera: poses of the drive ``(N, 4, 4)`` in the same axes.
        resolution: side of a cell.
        is_metric: whether lengths are metres; else they are camera heights.

    Returns:
        ``FREE``, ``OCCUPIED`` or ``UNKNOWN`` of each cell ``(H, W)``, largest y first, and x and y of the outer corner
        at the bottom left ``(2,)``.
    """
    metre = 1.0 if is_metric else 1.0 / _USUAL_CAMERA_HEIGHT_M
    ground_at = ground_along(mesh.points, T_world_camera, _USUAL_CAMERA_HEIGHT_M * metre)
    grid = Grid.around(mesh.points, resolution)
    shape = (grid.height, grid.width)
    free, occupied = np.zeros((2, grid.height * grid.width))
    for points, areas in samples(mesh, resolution):
        cells = grid.cells(points)
        touched, which = np.unique(cells, return_inverse=True)
        above = points[:, 2] - ground_at(grid.centres(touched))[which]
        on_ground = np.abs(above) < OBSTACLE_FROM_M * metre
        standing = (above >= OBSTACLE_FROM_M * metre) & (above <= OBSTACLE_TO_M * metre)
        for total, chosen in ((free, on_ground), (occupied, standing)):
            total += np.bincount(cells[chosen], areas[chosen], len(total))
    is_free = (free >= _MIN_FREE_AREA * resolution**2).reshape(shape).astype(np.uint8)
    hole = max(int(_HOLE_M * metre / resolution), 1)
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (hole, hole))
    values = np.full(shape, UNKNOWN, np.uint8)
    values[cv2.morphologyEx(is_free, cv2.MORPH_CLOSE, element) > 0] = FREE
    values[(occupied >= _MIN_OCCUPIED_AREA * resolution**2).reshape(shape)] = OCCUPIED
    return np.ascontiguousarray(values[::-1]), grid.corner


def samples(mesh: Ply, resolution: float) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Points ``(S, 3)`` spread evenly over each triangle, several in the area of a cell, and their areas ``(S,)``."""
    assert mesh.triangles is not None
    vertices = mesh.points
    for start in range(0, len(mesh.triangles), _CHUNK):
        corners = vertices[mesh.triangles[start : start + _CHUNK]]
        edges = corners[:, 1:] - corners[:, :1]
        areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        counts = np.ceil(_SAMPLES_A_CELL * areas / resolution**2).astype(np.int64)
        for part in np.array_split(
            np.arange(len(counts)), max(int(counts.sum()) // (4 * _CHUNK), 1)
        ):
            rows = np.repeat(part, counts[part])
            within = np.arange(len(rows)) - np.repeat(
                np.cumsum(counts[part]) - counts[part], counts[part]
            )
            uv = (0.5 + within[:, None] * _EVENLY) % 1.0
            # the other half of the square
            uv = np.where(uv.sum(axis=1, keepdims=True) > 1.0, 1.0 - uv, uv)
            yield (
                corners[rows, 0] + (uv[:, :, None] * edges[rows]).sum(axis=1),
                areas[rows] / counts[rows],
            )


def ground_along(
    points: FloatArray, T_world_camera: FloatArray, camera_height: float
) -> Callable[[FloatArray], FloatArray]:
    """The ground by points of the map ``(P, 3)``, z up, under cameras ``(N, 4, 4)`` in the same axes.

    ``camera_height`` is a first guess, which the map then corrects.

    Args:
        points: of the map ``(P, 3)``, z up.
        T_world_camera: poses of the cameras ``(N, 4, 4)`` in the same axes.
        camera_height: a first guess, in the unit of the points.

    Returns:
        Its height ``(P,)`` under places ``(P, 2)``; NaN far from the drive.

    Raises:
        RunError: the map has no ground below the cameras.
    """
    chosen = moved_rows(T_world_camera, _ANCHOR_STEP * camera_height, math.inf)
    cameras, up = T_world_camera[chosen, :3, 3], -T_world_camera[chosen, :3, 1]
    tree = cKDTree(points[:, :2])

    # twice: all at once take 0.7 GB a kilometre
    def around() -> Iterator[tuple[FloatArray, FloatArray]]:
        for camera, axis in zip(cameras, up, strict=True):
            near = points[tree.query_ball_point(camera[:2], _RADIUS * camera_height)]
            yield near, -((near - camera) @ axis)

    limits = _NEAREST * camera_height, _FURTHEST * camera_height
    found = (depth[(depth > limits[0]) & (depth < limits[1])] for _, depth in around())
    medians = [median(depth) for depth in found if len(depth) >= _MIN_POINTS]
    if not medians:
        raise RunError(
            "the map has no ground below the cameras, so free and occupied cannot be told apart"
        )
    height = median(medians)
    planes = [
        _plane(
            near[np.abs(depth - height) < _BAND * height],
            camera - height * axis,
            -axis[:2] / axis[2],
            height,
        )
        for (near, depth), camera, axis in zip(around(), cameras, up, strict=True)
    ]
    anchors, slopes = map(np.array, zip(*planes))
    return partial(_heights, anchors, slopes, _REACH * height)


def _heights(
    anchors: FloatArray, slopes: FloatArray, reach: float, places: FloatArray
) -> FloatArray:
    """By planes ``z = z0 + slope (x - x0)`` under ``anchors`` ``(A, 3)``, with ``slopes`` ``(A, 2)``."""
    count = min(_NEIGHBOURS, len(anchors))
    distances, nearest = (
        each.reshape(len(places), count) for each in cKDTree(anchors[:, :2]).query(places, k=count)
    )
    offsets = places[:, None] - anchors[nearest, :2]
    planes = anchors[nearest, 2] + (slopes[nearest] * offsets).sum(axis=2)
    # neighbours count by their distance beyond the nearest, so that planes go over into each other
    weights = 1.0 / (distances - distances[:, :1] + 0.05 * reach / _REACH)
    blended = (planes * weights).sum(axis=1) / weights.sum(axis=1)
    return np.where(distances[:, 0] <= reach, blended, np.nan)


def write_ros_map(
    path: Path, cells: NDArray[np.uint8], corner: FloatArray, resolution: float, unit: str
) -> None:
    """Write a grid as `occupancy_grid` gives it: ``<name>.pgm`` and, after it, ``<name>.yaml``, each atomically.

    ``map_server`` takes lengths for metres, whatever their ``unit`` is: a comment says so.

    Args:
        path: of the YAML file.
        cells: the grid ``(H, W)`` as a picture.
        corner: smallest x and y ``(2,)``.
        resolution: the side of a cell.
        unit: of all lengths.

    Raises:
        RunError: a file cannot be written.
    """
    image = path.with_suffix(".pgm")
    write_atomically(image, cv2.imencode(".pgm", cells)[1].tobytes(), RunError)
    description = {
        "image": image.name,
        "resolution": resolution,
        "origin": [*corner.tolist(), 0.0],
        "negate": 0,
    }
    text = yaml.safe_dump(description | _THRESHOLDS, sort_keys=False, default_flow_style=None)
    write_atomically(path, f"# lengths in {unit}\n{text}", RunError)


def _plane(
    points: FloatArray, start: FloatArray, tilt: FloatArray, height: float
) -> tuple[FloatArray, FloatArray]:
    """A robust plane through points, near the one through ``start`` with slope ``tilt``: its point and slope."""
    if len(points) < _MIN_POINTS:
        return start, tilt
    offsets = points[:, :2] - start[:2]
    residual_of = points[:, 2] - start[2] - offsets @ tilt
    design = np.column_stack([np.ones(len(points)), offsets / (_RADIUS * height)])
    prior = np.diag([0.0, 1.0, 1.0]) * _TILT_PRIOR * len(points)
    change = np.array([np.median(residual_of), 0.0, 0.0])
    for _ in range(_LEAST_SQUARES_ROUNDS):
        ratio = (residual_of - design @ change) / (_TUKEY * height)
        weights = np.clip(1 - ratio**2, 0, None) ** 2
        if weights.sum() < _MIN_POINTS / 2:
            return start, tilt
        weighted = design * weights[:, None]
        change = np.linalg.solve(weighted.T @ design + prior, weighted.T @ residual_of)
    return start + np.array([0.0, 0.0, change[0]]), tilt + change[1:] / (_RADIUS * height)
