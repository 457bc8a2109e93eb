"""The ground along a drive: a plane under each stretch of it, from the map close to the cameras."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from slam.geometry.se3 import FloatArray
from slam.runtime.errors import RunError

# lengths in camera heights
_ANCHOR_STEP = 0.6
_RADIUS = 3.5
_NEAREST, _FURTHEST = 0.4, 2.5  # a road lies so far below the camera
_BAND = 0.3  # around it, surface of the road and kerbs
_REACH = 12.0
_MIN_POINTS = 30
_LEAST_SQUARES_ROUNDS = 6
_TUKEY = 0.12
_TILT_PRIOR = 0.05  # weight of the camera's own tilt, against one of a point at the edge of the neighbourhood
_NEIGHBOURS = 6


@dataclass(frozen=True)
class Ground:
    """Planes ``z = z0 + slope (x - x0)`` under ``anchors`` ``(A, 3)``, with ``slopes`` ``(A, 2)``; z is up."""

    anchors: FloatArray
    slopes: FloatArray
    reach: float

    def heights(self, places: FloatArray) -> FloatArray:
        """Height of the ground ``(P,)`` under places ``(P, 2)``; NaN far from the drive."""
        count = min(_NEIGHBOURS, len(self.anchors))
        distances, nearest = cKDTree(self.anchors[:, :2]).query(places, k=count)
        distances, nearest = distances.reshape(len(places), count), nearest.reshape(len(places), count)
        offsets = places[:, None] - self.anchors[nearest, :2]
        planes = self.anchors[nearest, 2] + (self.slopes[nearest] * offsets).sum(axis=2)
        # neighbours count by their distance beyond the nearest, so that planes go over into each other
        weights = 1.0 / (distances - distances[:, :1] + 0.05 * self.reach / _REACH)
        blended = (planes * weights).sum(axis=1) / weights.sum(axis=1)
        return np.where(distances[:, 0] <= self.reach, blended, np.nan)


def ground_along(points: FloatArray, T_world_camera: FloatArray, camera_height: float) -> Ground:
    """Fit the ground.

    Args:
        points: of the map ``(P, 3)``, z up.
        T_world_camera: poses ``(N, 4, 4)`` in the same axes.
        camera_height: a first guess, which the map then corrects.

    Raises:
        RunError: there is no map below the cameras.
    """
    chosen = _spread(T_world_camera, _ANCHOR_STEP * camera_height)
    cameras, up = T_world_camera[chosen, :3, 3], -T_world_camera[chosen, :3, 1]
    tree = cKDTree(points[:, :2])

    def around() -> Iterator[tuple[FloatArray, FloatArray]]:  # twice: all at once take 0.7 GB a kilometre
        for camera, axis in zip(cameras, up, strict=True):
            near = points[tree.query_ball_point(camera[:2], _RADIUS * camera_height)]
            yield near, -((near - camera) @ axis)

    limits = _NEAREST * camera_height, _FURTHEST * camera_height
    found = (depth[(depth > limits[0]) & (depth < limits[1])] for _, depth in around())
    medians = [float(np.median(depth)) for depth in found if len(depth) >= _MIN_POINTS]
    if not medians:
        raise RunError("the map has no ground below the cameras, so free and occupied cannot be told apart")
    height = float(np.median(medians))
    anchors, slopes = [], []
    for (near, depth), camera, axis in zip(around(), cameras, up, strict=True):
        ground = near[np.abs(depth - height) < _BAND * height]
        start = camera - height * axis
        anchor, slope = _plane(ground, start, -axis[:2] / axis[2], _RADIUS * height)
        anchors.append(anchor)
        slopes.append(slope)
    return Ground(np.array(anchors), np.array(slopes), _REACH * height)


def _spread(T_world_camera: FloatArray, step: float) -> list[int]:
    """Poses at least so far from the one before."""
    chosen = [0]
    for k, T in enumerate(T_world_camera):
        if np.linalg.norm(T[:3, 3] - T_world_camera[chosen[-1], :3, 3]) >= step:
            chosen.append(k)
    return chosen


def _plane(points: FloatArray, start: FloatArray, tilt: FloatArray, radius: float) -> tuple[FloatArray, FloatArray]:
    """A robust plane through points, near the one through ``start`` with slope ``tilt``: its point and slope."""
    if len(points) < _MIN_POINTS:
        return start, tilt
    places = (points[:, :2] - start[:2]) / radius
    residual_of = points[:, 2] - start[2] - (points[:, :2] - start[:2]) @ tilt
    design = np.column_stack([np.ones(len(points)), places])
    prior = np.diag([0.0, 1.0, 1.0]) * _TILT_PRIOR * len(points)
    change = np.array([np.median(residual_of), 0.0, 0.0])
    for _ in range(_LEAST_SQUARES_ROUNDS):
        ratio = (residual_of - design @ change) / (_TUKEY * radius / _RADIUS)
        weights = np.clip(1 - ratio**2, 0, None) ** 2
        if weights.sum() < _MIN_POINTS / 2:
            return start, tilt
        weighted = design * weights[:, None]
        change = np.linalg.solve(weighted.T @ design + prior, weighted.T @ residual_of)
    return start + np.array([0.0, 0.0, change[0]]), tilt + change[1:] / radius
