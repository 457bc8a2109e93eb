"""The localisation map of a run (``places.npz``): features, their 3-D points and the poses they were seen from.

Points are triangulated among neighbouring places; learned depth gives the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from slam.frames import Intrinsics, View
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray, Rows, apply, invert
from slam.loops.verification import LoopThresholds, matches
from slam.loops.vocabulary import joined
from slam.runtime.errors import RunError

_FORMAT = 1
_ARRAYS = ("camera", "frames", "counts", "T_world_camera", "pixels", "descriptors", "points")
_NEIGHBOURS = 4  # places on either side that a place is matched with
_LEAST_SIGHTINGS = 3
_LEAST_ANGLE = np.deg2rad(1.0)  # between two rays of a point
# of learned depth, median: on streets it is 0.06 to 0.12, in a kitchen 0.4
_LARGEST_DEPTH_ERROR = 0.2


@dataclass(frozen=True)
class Places:
    """Views of one drive, points in the unit of its trajectory; ``T_world_camera`` ``(V, 4, 4)`` row by row."""

    intrinsics: Intrinsics
    views: tuple[View, ...]
    T_world_camera: FloatArray

    def write(self, path: Path) -> None:
        """Write as ``.npz``; ``docs/localisation.md`` describes each array."""
        camera = self.intrinsics
        np.savez_compressed(
            path,
            format=np.array(_FORMAT),
            camera=np.array(
                [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
            ),
            undistorted=np.array(camera.undistorted),
            frames=np.array([view.index for view in self.views], np.int64),
            counts=np.array([len(view) for view in self.views], np.int64),
            T_world_camera=self.T_world_camera,
            pixels=joined(self.views, "pixels", 2, np.float32),
            descriptors=joined(self.views, "descriptors", 32, np.uint8),
            points=joined(self.views, "points", 3, np.float32),
        )

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read what ``write`` wrote.

        Raises:
            RunError: the file is missing, damaged or of another version.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                content = {name: file[name] for name in ("format", *_ARRAYS)}
                undistorted = "undistorted" in file and bool(file["undistorted"])
            version = int(content["format"])
        except FileNotFoundError as error:
            raise RunError(f"{path} is missing: run the sequence again") from error
        # Damaged bytes raise almost anything in zipfile, zlib, tokenize and NumPy: no list of types
        # is complete.
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise RunError(f"{path} is damaged ({reason}): run the sequence again") from error
        if version != _FORMAT:
            raise RunError(f"{path} has format {version}, this version reads {_FORMAT}: run again")
        width, height, *pinhole = content["camera"].tolist()
        frames, ends = content["frames"].tolist(), np.cumsum(content["counts"])
        # the part after the last view is empty
        parts = (np.split(content[key], ends)[:-1] for key in ("pixels", "descriptors", "points"))
        views = map(View, frames, *parts)
        camera = Intrinsics(int(width), int(height), *pinhole, undistorted=undistorted)
        return cls(camera, tuple(views), content["T_world_camera"])


@dataclass(frozen=True)
class Tracks:
    """Points ``(P, 3)`` in the world, NaN where unknown, and their sightings ``(S,)``.

    A sighting has the row of its place in ``views``, its row there in ``corners``, and that of its
    ``point``.
    """

    points: FloatArray
    views: Rows
    corners: Rows
    point: Rows
    errors_px: FloatArray


class PlaceStructure:
    """The points of each place in the world, made when they are asked for first and kept."""

    def __init__(self, places: Places, thresholds: LoopThresholds) -> None:
        self._places, self._thresholds = places, thresholds
        self._T_camera_world = invert(places.T_world_camera)
        self._around = cache(self._triangulated_around)
        self._first = np.cumsum([0, *map(len, places.views)])
        pixels = [np.zeros((0, 2)), *(view.pixels.astype(np.float64) for view in places.views)]
        self._pixels: FloatArray = np.concatenate(pixels)

    def points(self, row: int, learned: bool) -> FloatArray:
        """Points ``(M, 3)`` of the corners of a place, NaN where unknown; ``learned``: with those of learned depth."""
        points = self._around(row).points
        if not learned:
            return points
        by_depth = apply(
            self._places.T_world_camera[row], self._places.views[row].points.astype(np.float64)
        )
        return np.where(np.isfinite(points), points, by_depth)

    def pixels(self, views: Rows, corners: Rows) -> FloatArray:
        """Where places ``(S,)`` see their corners ``(S,)``, ``(S, 2)``."""
        pixels: FloatArray = self._pixels[self._first[views] + corners]
        return pixels

    def confirms_depth(self, rows: Sequence[int]) -> bool:
        """Whether learned depth of these places agrees with triangulation, as on streets; true where none tells."""
        ratios = [np.zeros(0)]
        for row in rows:
            triangulated = apply(self._T_camera_world[row], self._around(row).points)[:, 2]
            ratios.append(self._places.views[row].points[:, 2] / triangulated)
        with np.errstate(invalid="ignore", divide="ignore"):  # behind the camera
            errors = np.abs(np.log(np.concatenate(ratios)))
        errors = errors[np.isfinite(errors)]
        return not len(errors) or median(errors) < _LARGEST_DEPTH_ERROR

    def tracks(self) -> Tracks:
        """Corners of all places joined to points that three or more of them see."""
        first = self._first
        of_places, of_neighbours = [], []
        for row in range(len(self._places.views)):
            nearby = self._around(row)
            known = np.isfinite(nearby.points[nearby.point, 0])
            of_places.append(first[row] + nearby.point[known])
            of_neighbours.append(first[nearby.views[known]] + nearby.corners[known])
        one, other = np.concatenate(of_places), np.concatenate(of_neighbours)
        joined = csr_array((np.ones(len(one)), (one, other)), (first[-1], first[-1]))
        _, track = connected_components(joined, directed=False)
        views = np.repeat(np.arange(len(self._places.views)), np.diff(first))
        # of two corners of a place that were joined to one point, one is wrong
        _, once = np.unique(track * len(self._places.views) + views, return_index=True)
        return self._triangulated(
            views[once], once - first[views[once]], track[once], int(track.max(initial=-1)) + 1
        )

    def _triangulated_around(self, row: int) -> Tracks:
        """A point for each corner of a place, by the places around it."""
        places = self._places.views
        sightings = []
        for other in range(max(0, row - _NEIGHBOURS), min(len(places), row + _NEIGHBOURS + 1)):
            point = corner = np.arange(len(places[row]))
            if other != row:
                point, corner = matches(places[row], places[other], self._thresholds)
            sightings.append([np.full(len(corner), other), corner, point])
        views, corners, points = np.concatenate(sightings, axis=1)
        return self._triangulated(views, corners, points, len(places[row]))

    def _triangulated(self, views: Rows, corners: Rows, point: Rows, count: int) -> Tracks:
        """Points ``(count, 3)``, NaN where unknown, and the sightings that agree with them.

        A sighting is of a ``point``, at a row of the ``corners`` of a place among the ``views``,
        ``(S,)`` each.
        """
        intrinsics, allowed_px = self._places.intrinsics, self._thresholds.reprojection_px
        rays, focal = intrinsics.rays(self.pixels(views, corners)), (intrinsics.fx, intrinsics.fy)
        for tolerance in (2.0, 1.0, 1.0, 1.0):  # wrong matches spoil the first points
            T = self._T_camera_world[views]
            points, angle = triangulate(T, rays, point, count)
            error = reprojection_errors(T, points[point], rays, focal)
            kept = error < tolerance * allowed_px
            views, corners, point = views[kept], corners[kept], point[kept]
            rays, error = rays[kept], error[kept]
        confirmed = np.bincount(point, minlength=count) >= _LEAST_SIGHTINGS
        points[~confirmed | (angle < _LEAST_ANGLE)] = np.nan
        return Tracks(points, views, corners, point, error)


def triangulate(
    T_camera_world: FloatArray, rays: FloatArray, point: NDArray[np.int64], count: int
) -> tuple[FloatArray, FloatArray]:
    """Points ``(count, 3)`` closest to all their rays, and the widest angle between two of each point's rays, radians.

    Least squares of the distances to the rays: ``sum (I - d d^T) (X - c) = 0``. NaN where rays are
    parallel.

    Args:
        T_camera_world: of each sighting ``(S, 4, 4)``.
        rays: of each sighting in its camera ``(S, 3)``.
        point: of each sighting ``(S,)``.
        count: points.
    """
    R = T_camera_world[:, :3, :3]
    centres = -np.einsum("sji,sj->si", R, T_camera_world[:, :3, 3])
    directions = np.einsum("sji,sj->si", R, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    A, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(A, point, across)
    np.add.at(b, point, np.einsum("sij,sj->si", across, centres))
    usable = np.linalg.det(A) > 1e-12
    X = np.full((count, 3), np.nan)
    X[usable] = np.linalg.solve(A[usable], b[usable][:, :, None])[:, :, 0]
    # against the first ray of each point: the widest angle within a factor of two, and in one pass
    first = np.full(count, -1)
    first[point[::-1]] = np.arange(len(point))[::-1]
    cosine = (directions * directions[first[point]]).sum(axis=1)
    angle = np.zeros(count)
    np.maximum.at(angle, point, np.arccos(np.clip(cosine, -1.0, 1.0)))
    return X, angle


def reprojection_errors(
    T_camera_world: FloatArray, points: FloatArray, rays: FloatArray, focal: tuple[float, float]
) -> FloatArray:
    """Distances in pixels ``(S,)`` between sightings and their points; infinite behind a camera.

    Args:
        T_camera_world: of each sighting ``(S, 4, 4)``.
        points: of each sighting ``(S, 3)``.
        rays: of each sighting in its camera ``(S, 3)``, z = 1.
        focal: lengths along both axes, pixels.
    """
    X = np.einsum("sij,sj->si", T_camera_world[:, :3, :3], points) + T_camera_world[:, :3, 3]
    in_front = X[:, 2] > 0
    offset = (X[:, :2] / np.where(in_front, X[:, 2], 1.0)[:, None] - rays[:, :2]) * focal
    return np.where(in_front, np.linalg.norm(offset, axis=1), np.inf)
