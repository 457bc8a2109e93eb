"""Colours of the surface: the sharpest keyframe of every stretch, with the exposures evened out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.spatial import cKDTree

from slam.frames import DepthMap, Image, Intrinsics
from slam.geometry.se3 import FloatArray, apply, invert, rotation_angle
from slam.mapping.depth import DepthFilters, KeyframeDepth, sampled
from slam.mapping.submap import MergedSubmaps

_STEP = 0.1  # of the largest fused depth
_STEP_DEG = 10.0
_STRIDE = 7  # of the pixels that compare the brightness of two views
_SAME_SURFACE = 0.05  # largest relative difference of depth
_LEAST_SHARED = 50  # pixels
_DARK = 8.0  # grey levels below which a ratio says little
_BRIGHT = 247.0
_GREY = 128
_NEARNESS = 4  # power of the distance that a view's weight falls with
_SAME_VOXELS = 1.5  # or so many voxels
_NEAREST_VOXELS = 0.5  # least depth of a point that a view may show
_EXPOSURE_PRIOR = 0.01  # of equal exposures, over the information in the brightness of two views


class ViewChooser:
    """Chooses the views of one submap after the other."""

    def __init__(self, filters: DepthFilters, depth_max_m: float) -> None:
        """Of the camera of these filters; ``depth_max_m`` is the largest fused depth."""
        self._filters, self._step_m = filters, _STEP * depth_max_m
        self._chosen: list[KeyframeDepth] = []
        self._steps: list[float] = []
        self._begin: FloatArray | None = None
        self._best: tuple[float, KeyframeDepth] | None = None  # with its sharpness
        self._last: KeyframeDepth | None = None

    def add(self, view: KeyframeDepth, kept: DepthMap) -> None:
        """A fused frame with the depth that passed the filters."""
        if self._begin is not None and has_moved(view.T_world_camera, self._begin, self._step_m, _STEP_DEG):
            self._close()
        if self._begin is None:
            self._begin = view.T_world_camera
        sharpness = _sharpness(view.image)
        if self._best is None or sharpness > self._best[0]:
            self._best = sharpness, replace(view, depth=kept, relative_sigma=None)

    def take(self, camera: Intrinsics) -> dict[str, Any]:
        """The views since the last call, as fields of a `Submap`."""
        self._close()
        views, steps = self._chosen, self._steps
        self._chosen, self._steps = [], []
        height, width = camera.height, camera.width
        return {
            "T_world_camera": np.array([view.T_world_camera for view in views]).reshape(-1, 4, 4),
            "images": np.array([view.image for view in views], dtype=np.uint8).reshape(-1, height, width, 3),
            "depths": np.array([view.depth for view in views], dtype=np.float16).reshape(-1, height, width),
            "brightness_steps": np.array(steps, dtype=np.float64),
            "camera": np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        }

    def _close(self) -> None:
        if self._best is not None:
            _, view = self._best
            self._steps.append(np.nan if self._last is None else self._brightness_step(view, self._last))
            self._chosen.append(view)
            self._last = view
        self._begin = self._best = None

    def _brightness_step(self, view: KeyframeDepth, before: KeyframeDepth) -> float:
        """Logarithm of the brightness of surfaces that two views share, over that in the one before."""
        u, v, z = self._filters.projected(view, before)
        same = np.abs(sampled(before.depth, u, v) - z) < _SAME_SURFACE * z
        here, there = (grey[same][::_STRIDE] for grey in (_grey(view.image), sampled(_grey(before.image), u, v)))
        usable = (np.minimum(here, there) > _DARK) & (np.maximum(here, there) < _BRIGHT)
        if usable.sum() < _LEAST_SHARED:
            return float("nan")
        return float(np.median(np.log(here[usable]) - np.log(there[usable])))


def has_moved(T_world_camera: FloatArray, T_world_before: FloatArray, step_m: float, turn_deg: float) -> bool:
    """Whether a camera has moved by a step or a turn."""
    T_before_camera = invert(T_world_before) @ T_world_camera
    turned = float(rotation_angle(T_before_camera[:3, :3]))
    return float(np.linalg.norm(T_before_camera[:3, 3])) >= step_m or turned >= np.deg2rad(turn_deg)


def moved_rows(T_world_camera: FloatArray, step_m: float, turn_deg: float) -> list[int]:
    """The first of some poses ``(N, 4, 4)``, and each before which the camera has moved since the last chosen one."""
    chosen: list[int] = []
    for row, T_next in enumerate(T_world_camera):
        if not chosen or has_moved(T_next, T_world_camera[chosen[-1]], step_m, turn_deg):
            chosen.append(row)
    return chosen


def _grey(image: Image) -> FloatArray:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.float64)


def _sharpness(image: Image) -> float:
    """Variance of the Laplacian over that of the grey levels, so that contrast does not count."""
    grey = _grey(image)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var() / (grey.var() + 1.0))


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
