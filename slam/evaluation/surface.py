"""The true surface around a drive: measured points accumulated at true poses, one stretch of road at a time.

A long drive is sampled: a number of stretches, evenly spread, with all that cameras on them see. Time and memory have a
bound, whatever the length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slam.frames import Mask
from slam.geometry.se3 import FloatArray, apply, path_distance

RANGE_M = 25.0  # of map points and of the true surface to the nearest camera
STRETCH_M = 100.0
MOST_STRETCHES = 5
TRUTH_VOXEL_M = 0.05

_BEYOND_M = 5.0  # of the range of map points: a wrong one may be nearest to surface out there
_WAITING_POINTS = 2_000_000
_NEAR_TRUTH_M = 5.0  # of a camera to the nearest one that measured the surface
_KEY_BITS = 21  # a coordinate in voxels, both signs

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Surface:
    """Points ``(P, 3)`` of the true surface in the world, and whether an image shows them within 25 m ``(P,)``."""

    points: FloatArray
    in_image: Mask


@dataclass(frozen=True)
class SurfaceTruth:
    """A source of the true surface; its world is that of the true poses.

    ``name`` says what it is, ``frames`` ``(F,)`` which frames measured the surface, ``view`` gives the surface as one
    of them measured it. ``in_field`` says whether the sensor could have measured points ``(P, 3)`` from any of some
    frames that were viewed, if nothing hid them. ``distance``, where the surface is known exactly, gives the distances
    ``(P,)`` of points ``(P, 3)`` to it.
    """

    name: str
    frames: Indices
    view: Callable[[int], Surface]
    in_field: Callable[[FloatArray, Indices], Mask]
    distance: Callable[[FloatArray], FloatArray] | None = None


def thinned(points: FloatArray, voxel_m: float, order: Indices) -> Indices:
    """Of the points ``(P, 3)`` in each voxel the one that comes first in an order ``(P,)``: their indices."""
    key = np.zeros(len(points), dtype=np.int64)
    for axis in points.T:  # one at a time, for there are millions
        key = (key << _KEY_BITS) | (np.floor(axis / voxel_m).astype(np.int64) + (1 << (_KEY_BITS - 1)))
    first: Indices = order[np.unique(key[order], return_index=True)[1]]
    return first


def stretches(T_world_camera: FloatArray, truth_frames: Indices) -> list[Indices]:
    """Frames of stretches of 100 m along a drive with known surface: all of them, or five evenly spread.

    Args:
        T_world_camera: true poses of all frames ``(N, 4, 4)``.
        truth_frames: frames that measured the surface; others count where the camera is within 5 m of one of them.
    """
    positions = T_world_camera[:, :3, 3]
    away, _ = cKDTree(positions[truth_frames]).query(positions)
    number = (path_distance(T_world_camera) / STRETCH_M).astype(np.int64)
    parts = [np.flatnonzero((number == k) & (away <= _NEAR_TRUTH_M)) for k in range(int(number[-1]) + 1)]
    parts = [part for part in parts if len(part)]
    if len(parts) <= MOST_STRETCHES:
        return parts
    chosen = ((np.arange(MOST_STRETCHES) + 0.5) * len(parts) / MOST_STRETCHES).astype(np.intp)
    return [parts[k] for k in chosen]


def nearby(T_world_camera: FloatArray, views: Indices, part: Indices) -> Indices:
    """The ``views`` that can see surfaces near a stretch of road."""
    positions = T_world_camera[:, :3, 3]
    away, _ = cKDTree(positions[part]).query(positions[views])
    near: Indices = views[away <= 2 * RANGE_M]
    return near


def accumulated(truth: SurfaceTruth, views: Indices, positions: FloatArray) -> Surface:
    """The surface from all ``views``, one point in each voxel of 5 cm, one in an image where there is one.

    Of it what is in the box around ``positions`` ``(N, 3)`` of cameras and 30 m further.
    """
    margin = RANGE_M + _BEYOND_M
    low, high = positions.min(axis=0) - margin, positions.max(axis=0) + margin
    surface = Surface(np.empty((0, 3)), np.empty(0, dtype=bool))
    waiting: list[Surface] = []
    for number, frame in enumerate(views, 1):
        view = truth.view(int(frame))
        inside = ((view.points >= low) & (view.points <= high)).all(axis=1)
        waiting.append(Surface(view.points[inside], view.in_image[inside]))
        if number == len(views) or sum(len(each.points) for each in waiting) > _WAITING_POINTS:
            points = np.concatenate([surface.points, *(each.points for each in waiting)])
            in_image = np.concatenate([surface.in_image, *(each.in_image for each in waiting)])
            chosen = thinned(points, TRUTH_VOXEL_M, np.argsort(~in_image, kind="stable"))
            surface, waiting = Surface(points[chosen], in_image[chosen]), []
    return surface


def backprojected(depth_m: FloatArray, rays: FloatArray, T_world_camera: FloatArray, range_m: float) -> FloatArray:
    """Points ``(P, 3)`` in the world of z-depth ``(H, W)``, no further than ``range_m`` from the camera.

    Depth is 0 or not finite where unknown; ``rays`` ``(H, W, 3)`` go through every pixel, z = 1.
    """
    known = np.isfinite(depth_m) & (depth_m > 0)
    points = rays[known] * depth_m[known][:, None]
    near = points[np.linalg.norm(points, axis=1) <= range_m]
    return apply(T_world_camera, near)
