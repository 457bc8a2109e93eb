"""Colours of the surface from the nearest views, with their exposure evened out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.spatial import cKDTree

from slam.geometry.se3 import FloatArray, apply, invert
from slam.mapping.merged_submaps import MergedSubmaps

_GREY = 128
_NEARNESS = 4  # power of the distance that a view's weight falls with
_SAME_SURFACE = 0.05  # largest relative difference of depth
_SAME_VOXELS = 1.5  # or so many voxels
_NEAREST_VOXELS = 0.5  # least depth of a point that a view may show
_EXPOSURE_PRIOR = 0.01  # of equal exposures, over the information in the brightness of two views


class Painter:
    """Colours points by the views of all submaps."""

    def __init__(self, submaps: MergedSubmaps, voxel_size_m: float, reach_m: float) -> None:
        """Even out the exposure of all views."""
        self._submaps, self._voxel, self._range = submaps, voxel_size_m, reach_m
        self._gains = np.exp(-evened(submaps.brightness_steps))

    def colours(self, points_world: FloatArray) -> NDArray[np.uint8]:
        """RGB ``(P, 3)`` of points of the surface ``(P, 3)``; one that no view shows has that of the nearest shown."""
        total, weight = np.zeros((len(points_world), 3)), np.zeros(len(points_world))
        low, high = points_world.min(axis=0), points_world.max(axis=0)
        positions = self._submaps.T_world_views[:, :3, 3]
        away = np.linalg.norm(positions - np.clip(positions, low, high), axis=1)
        for view in np.flatnonzero(away < self._range):
            self._add(int(view), points_world, total, weight)
        shown = weight > 0
        if not shown.any():
            return np.full(points_world.shape, _GREY, np.uint8)
        colours = total / np.where(shown, weight, 1.0)[:, None]
        if not shown.all():
            _, nearest = cKDTree(points_world[shown]).query(points_world[~shown])
            colours[~shown] = colours[shown][nearest]
        return np.asarray(np.rint(np.clip(colours, 0, 255)), np.uint8)

    def _add(self, view: int, points_world: FloatArray, total: FloatArray, weight: FloatArray) -> None:
        """Add the colours of one view to those of the points that it shows."""
        number = int(self._submaps.submap_of_view[view])
        submap = self._submaps.read(number)
        own = view - int(np.searchsorted(self._submaps.submap_of_view, number))
        T_camera_world = invert(self._submaps.T_world_views[view])
        depth_of_points = points_world @ T_camera_world[2, :3] + T_camera_world[2, 3]
        ahead = np.flatnonzero(depth_of_points > _NEAREST_VOXELS * self._voxel)
        x, y, z = apply(T_camera_world, points_world[ahead]).T
        fx, fy, cx, cy = submap.camera
        depth, image = submap.depths[own], submap.images[own]
        u, v = np.rint(fx * x / z + cx), np.rint(fy * y / z + cy)
        inside = (u >= 0) & (u < depth.shape[1]) & (v >= 0) & (v < depth.shape[0])
        u, v, z, ahead = u[inside].astype(np.intp), v[inside].astype(np.intp), z[inside], ahead[inside]
        known = depth[v, u]
        same = (known > 0) & (np.abs(known - z) < np.maximum(_SAME_VOXELS * self._voxel, _SAME_SURFACE * z))
        shown, share = ahead[same], z[same] ** -_NEARNESS
        weight[shown] += share
        total[shown] += share[:, None] * (self._gains[view] * image[v[same], u[same]])


def evened(brightness_steps: FloatArray) -> FloatArray:
    """Logarithms of the brightness ``(N,)`` of views by the steps between them, as small as these allow.

    Least squares; a step that is NaN couples nothing.
    """
    count = len(brightness_steps)
    if count < 2:
        return np.zeros(count)
    steps = brightness_steps[1:]
    known = np.isfinite(steps)
    steps = np.where(known, steps, 0.0)
    banded, right = np.zeros((2, count)), np.zeros(count)
    banded[1] = _EXPOSURE_PRIOR
    banded[1, 1:] += known
    banded[1, :-1] += known
    banded[0, 1:] = -known.astype(float)
    right[1:] += steps
    right[:-1] -= steps
    solved: FloatArray = solveh_banded(banded, right)
    return solved
