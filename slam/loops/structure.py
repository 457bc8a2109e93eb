"""Points of the places of a run, triangulated among neighbouring places; learned depth gives the others."""

from __future__ import annotations

from functools import cache

import numpy as np

from slam.geometry.se3 import FloatArray, apply, invert
from slam.geometry.triangulation import triangulate
from slam.loops.places import Places
from slam.loops.thresholds import LoopThresholds
from slam.loops.verification import matches

_NEIGHBOURS = 4  # places on either side that a place is matched with
_LEAST_SIGHTINGS = 3
_LEAST_ANGLE = np.deg2rad(1.0)  # between two rays of a point
_LEAST_DEPTH = 1e-6


class PlaceStructure:
    """The points of each place in the world, made when they are asked for first and kept."""

    def __init__(self, places: Places, thresholds: LoopThresholds) -> None:
        self._places, self._thresholds = places, thresholds
        self._T_camera_world = invert(places.T_world_camera)
        self._triangulated_of = cache(self._triangulated)

    def points(self, row: int, learned: bool) -> FloatArray:
        """Points ``(M, 3)`` of the corners of a place, NaN where unknown; ``learned``: with those of learned depth."""
        points = self._triangulated_of(row)
        if not learned:
            return points
        by_depth = apply(self._places.T_world_camera[row], self._places.views[row].points.astype(np.float64))
        return np.where(np.isfinite(points), points, by_depth)

    def _triangulated(self, row: int) -> FloatArray:
        place, sightings = self._places.views[row], []
        for other in range(max(0, row - _NEIGHBOURS), min(len(self._places.views), row + _NEIGHBOURS + 1)):
            view = self._places.views[other]
            corners, seen = (np.arange(len(place)),) * 2 if other == row else matches(place, view, self._thresholds)
            sightings.append((np.full(len(corners), other), corners, view.pixels[seen].astype(np.float64)))
        camera, corner, pixels = map(np.concatenate, zip(*sightings, strict=True))
        T, intrinsics = self._T_camera_world, self._places.intrinsics
        for tolerance in (2.0, 1.0, 1.0):  # wrong matches spoil the first points
            points, _ = triangulate(T[camera], intrinsics.rays(pixels), corner, len(place))
            X = np.einsum("sij,sj->si", T[camera, :3, :3], points[corner]) + T[camera, :3, 3]
            ahead = X[:, 2] > _LEAST_DEPTH
            X[~ahead] = 1.0
            kept = ahead & (
                np.linalg.norm(intrinsics.project(X) - pixels, axis=1) < tolerance * self._thresholds.reprojection_px
            )
            camera, corner, pixels = camera[kept], corner[kept], pixels[kept]
        points, angle = triangulate(T[camera], intrinsics.rays(pixels), corner, len(place))
        confirmed = np.bincount(corner, minlength=len(place)) >= _LEAST_SIGHTINGS
        points[~confirmed | (angle < _LEAST_ANGLE)] = np.nan
        return points
