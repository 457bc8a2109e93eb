"""The ground plane before a car, fitted to learned depth: the camera's unscaled height.

With the plane ``n . X = h`` and a pixel's ray ``r`` (z = 1), ``1 / z = (n / h) . r``: inverse depth
is linear in the ray, and the ray has no noise, so errors of depth do not bias the fit as they bias
a fit to points.
"""

from __future__ import annotations

import numpy as np

from slam.frames import DepthMap, Intrinsics
from slam.frontend.visual.depth_error import DepthError
from slam.geometry.se3 import BoolArray, FloatArray, length_of

_POINTS = 1500  # approximate number of pixels
_LEAST_POINTS = 50  # with a usable depth
_HYPOTHESES = 150
_REWEIGHTINGS = 8
# top and bottom edge of the road, from horizon (0) to image bottom (1): above a bonnet
_ROAD_ROWS = 0.35, 0.97
_ROAD_TOP_WIDTH = 0.16  # width of the top edge over that of the image
_ROAD_BOTTOM_WIDTH = 0.5  # width of the bottom edge over that of the image
# largest angle between the plane's normal and the camera's y axis, degrees
_MAX_TILT_DEG = 12.0
_INLIER_RELATIVE_DEPTH = 0.05  # largest relative depth error of a plane inlier
_MIN_INLIER_RATIO = 0.5  # least inlier ratio of a usable frame


class GroundPlaneFitter:
    """Fits the road in a trapezoid in front of the car, by RANSAC and reweighted least squares on inverse depth."""

    def __init__(self, intrinsics: Intrinsics, seed: int = 0) -> None:
        """Sample the pixels of the trapezoid; ``seed`` is that of RANSAC."""
        self._seed = seed
        # rows, columns (P,) and rays (P, 3) of about so many pixels; the horizon is taken at cy (a
        # level camera)
        horizon, bottom = intrinsics.cy, intrinsics.height - 1.0
        top_row = horizon + _ROAD_ROWS[0] * (bottom - horizon)
        bottom_row = horizon + _ROAD_ROWS[1] * (bottom - horizon)
        area = (
            intrinsics.width * (bottom_row - top_row) * (_ROAD_TOP_WIDTH + _ROAD_BOTTOM_WIDTH) / 2
        )
        step = max(1.0, float(np.sqrt(max(area, 1.0) / _POINTS)))
        rows = np.arange(top_row, bottom_row, step).clip(0, bottom).astype(np.int64)[:, None]
        share = (rows - top_row) / (bottom_row - top_row)
        width = _ROAD_TOP_WIDTH + share * (_ROAD_BOTTOM_WIDTH - _ROAD_TOP_WIDTH)
        half = width * intrinsics.width / 2
        # every row from the left edge of the road to the right one
        across = intrinsics.cx - half + np.arange(0.0, _ROAD_BOTTOM_WIDTH * intrinsics.width, step)
        is_road = (across < intrinsics.cx + half) & (across >= 0) & (across < intrinsics.width)
        v, u = np.broadcast_to(rows, across.shape)[is_road], across[is_road].astype(np.int64)
        self._rows, self._columns, self._rays = v, u, intrinsics.rays(np.stack([u, v], axis=-1))

    def fit(self, depth_unscaled: DepthMap, error: DepthError) -> float | None:
        """The camera's unscaled height over the plane of learned z-depth ``(H, W)`` without the bias by its ``error``.

        The depth is at the size of the intrinsics; where it is unknown it is left out. None where too few pixels have
        one, or lie on one plane that is about level.
        """
        depth = error.corrected(depth_unscaled[self._rows, self._columns].astype(np.float64))
        inverse_depth = 1.0 / np.maximum(depth, 1e-9)
        usable = (inverse_depth > 0) & (inverse_depth < 1e8)  # false for NaN
        if usable.sum() < _LEAST_POINTS:
            return None
        rays, inverse_depth = self._rays[usable], inverse_depth[usable]  # (P, 3), (P,)
        scaled_normal = _ransac(rays, inverse_depth, self._seed)
        if scaled_normal is None:
            return None
        scaled_normal = _reweighted(rays, inverse_depth, scaled_normal)
        height = 1.0 / length_of(scaled_normal)
        inlier_ratio = float(_inliers(rays, inverse_depth, scaled_normal[None])[0].mean())
        is_level = scaled_normal[1] * height >= np.cos(np.deg2rad(_MAX_TILT_DEG))
        return height if is_level and inlier_ratio >= _MIN_INLIER_RATIO else None


def _ransac(rays: FloatArray, inverse_depth: FloatArray, seed: int) -> FloatArray | None:
    """``n / h`` ``(3,)`` of the level plane with most inliers, or None."""
    rng = np.random.default_rng(seed)
    samples = rng.integers(len(rays), size=(_HYPOTHESES, 3))
    minimal = rays[samples]  # (S, 3, 3)
    solvable = np.abs(np.linalg.det(minimal)) > 1e-6
    if not solvable.any():
        return None
    right = inverse_depth[samples[solvable]][..., None]
    planes = np.linalg.solve(minimal[solvable], right)[..., 0]  # (S, 3)
    level = planes[:, 1] > np.cos(np.deg2rad(_MAX_TILT_DEG)) * np.linalg.norm(planes, axis=1)
    if not level.any():
        return None
    planes = planes[level]
    votes = _inliers(rays, inverse_depth, planes).sum(axis=1)
    best: FloatArray = planes[votes.argmax()]
    return best


def _inliers(rays: FloatArray, inverse_depth: FloatArray, planes: FloatArray) -> BoolArray:
    """Inliers ``(S, P)`` of planes ``n / h`` ``(S, 3)`` by the relative error of depth."""
    over_measured = (rays / inverse_depth[:, None]).T.astype(np.float32)
    relative = planes.astype(np.float32) @ over_measured
    relative -= 1.0
    return np.abs(relative, out=relative) < _INLIER_RELATIVE_DEPTH


def _reweighted(rays: FloatArray, inverse_depth: FloatArray, plane: FloatArray) -> FloatArray:
    """Refine ``n / h`` by least squares with Cauchy weights on the relative error of inverse depth."""
    for _ in range(_REWEIGHTINGS):
        predicted = np.maximum(rays @ plane, 1e-9)
        residual = inverse_depth / predicted - 1.0
        weights = 1.0 / (predicted**2 * (1.0 + (residual / (0.5 * _INLIER_RELATIVE_DEPTH)) ** 2))
        weighted = rays * weights[:, None]
        plane = np.linalg.solve(weighted.T @ rays, weighted.T @ inverse_depth)
    return plane
