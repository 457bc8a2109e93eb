"""Keyframes of a drive as points and as an occupancy grid, at poses that loops may move; needs no ROS."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray, apply
from slam.mapping.occupancy import OBSTACLE_FROM_M, OBSTACLE_TO_M, Grid, ground_along
from slam.mapping.submap import has_moved

USUAL_CAMERA_HEIGHT_M = 1.65
UNKNOWN = -1  # of a cell
_LEAST_STANDING = 2  # points of a keyframe that make a cell occupied
_TURN_DEG = 15.0


@dataclass
class LiveMap:
    """Clouds ``(M, 3)`` of keyframes by frame, in their cameras; a keyframe is ``spacing`` from the one before, or 15
    degrees, and has its depth to ``depth_to``. Lengths are in the unit of the poses."""

    resolution: float
    spacing: float
    depth_to: float
    clouds: dict[int, FloatArray] = field(default_factory=dict)

    def add(self, clouds: dict[int, FloatArray], T_map_camera: FloatArray) -> list[int]:
        """Keep the frames that are far enough from the keyframe before, at poses ``(N, 4, 4)``; they are returned."""
        chosen = []
        for frame, cloud in sorted(clouds.items()):
            last = max(self.clouds, default=None)
            if last is None or has_moved(
                T_map_camera[frame], T_map_camera[last], self.spacing, _TURN_DEG
            ):
                self.clouds[frame] = cloud[cloud[:, 2] <= self.depth_to]
                chosen.append(frame)
        return chosen

    def points(self, T_map_camera: FloatArray) -> FloatArray:
        """All points ``(P, 3)``, one of each cube as large as a cell."""
        points: FloatArray = np.concatenate(
            [np.zeros((0, 3)), *(apply(T_map_camera[k], cloud) for k, cloud in self.clouds.items())]
        )
        cubes = np.floor(points / self.resolution).astype(np.int64)
        _, first = np.unique(cubes @ np.array([1, 1 << 20, 1 << 40]), return_index=True)
        thinned: FloatArray = points[np.sort(first)]
        return thinned

    def grid(
        self, T_map_camera: FloatArray, camera_height: float, metre: float
    ) -> tuple[NDArray[np.int8], Grid]:
        """Occupancy in percent ``(H, W)``, smallest y first: the share of keyframes that see something stand there.

        Args:
            T_map_camera: poses of all frames ``(N, 4, 4)``, z up.
            camera_height: above the ground, in the unit of the poses; a first guess.
            metre: in that unit.

        Raises:
            RunError: no ground below the cameras, or too many cells.
        """
        points = self.points(T_map_camera)
        ground_at = ground_along(points, T_map_camera, camera_height)
        grid = Grid.around(points, self.resolution)
        seen, occupied = np.zeros(grid.width * grid.height), np.zeros(grid.width * grid.height)
        for frame, cloud in self.clouds.items():
            X = apply(T_map_camera[frame], cloud)
            cells, which = np.unique(grid.cells(X), return_inverse=True)
            above = (X[:, 2] - ground_at(grid.centres(cells))[which]) / metre
            standing = (above >= OBSTACLE_FROM_M) & (above <= OBSTACLE_TO_M)
            stands = np.bincount(which[standing], minlength=len(cells)) >= _LEAST_STANDING
            lies = np.bincount(which[np.abs(above) < OBSTACLE_FROM_M], minlength=len(cells)) > 0
            seen[cells] += stands | lies
            occupied[cells] += stands
        percent = np.where(seen > 0, 100 * occupied / np.maximum(seen, 1), UNKNOWN)
        return percent.round().astype(np.int8).reshape(grid.height, grid.width), grid
