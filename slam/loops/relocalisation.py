"""A lost camera found again among the keyframes of its map, by corners that match those with points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.frames import Intrinsics, View
from slam.geometry.se3 import FloatArray, apply
from slam.loops.retrieval import PlaceIndex
from slam.loops.verification import OF_KEYFRAMES, LoopVerifier, Sighting, matches

_PLACES_TRIED = 6
# a single image has no points of its own that would confirm the pose, so it takes twice those of a loop
_LEAST_POINTS = 30


@dataclass(frozen=True)
class Relocalised:
    """``T_camera_map`` and the corners that see points: ``corners`` ``(M,)`` of the image.

    ``keyframes`` ``(M,)`` are the rows of keyframes with these points and ``keyframe_corners`` ``(M,)`` theirs.
    """

    T_camera_map: FloatArray
    corners: NDArray[np.intp]
    keyframes: NDArray[np.intp]
    keyframe_corners: NDArray[np.intp]

    @property
    def nearest(self) -> int:
        """The row of the keyframe with most of the points."""
        return int(np.bincount(self.keyframes).argmax())


class Relocaliser:
    """Finds single images among the keyframes of one map."""

    def __init__(self, views: Sequence[View], T_map_camera: FloatArray, intrinsics: Intrinsics, seed: int = 0) -> None:
        """Index keyframes, at least one, with points in the unit of the map and poses ``(V, 4, 4)``."""
        self._views, self._T_map_camera, self._intrinsics = views, T_map_camera, intrinsics
        self._index = PlaceIndex(views)
        self._verifier = LoopVerifier(OF_KEYFRAMES, intrinsics, seed=seed)

    def locate(self, image: View) -> Relocalised | None:
        """The pose with most inliers at one of the similar keyframes, and all points that confirm it; None with few."""
        keyframes, rows, points = self._matched(image)
        best: Sighting | None = None
        for keyframe in np.unique(keyframes):
            here = keyframes == keyframe
            seen = self._verifier.resect(points[here].astype(np.float32), image.pixels[rows[here, 1]])
            if isinstance(seen, Sighting) and (best is None or len(seen.inliers) > len(best.inliers)):
                best = seen
        if best is None:
            return None
        X = apply(best.T_camera_points, points)
        ahead = X[:, 2] > 0
        X[~ahead, 2] = 1.0
        residual = np.linalg.norm(self._intrinsics.project(X) - image.pixels[rows[:, 1]], axis=1)
        kept = np.flatnonzero(ahead & (residual < OF_KEYFRAMES.reprojection_px))
        _, first = np.unique(rows[kept, 1], return_index=True)
        kept = kept[first]
        if len(kept) < _LEAST_POINTS:
            return None
        return Relocalised(best.T_camera_points, rows[kept, 1], keyframes[kept], rows[kept, 0])

    def _matched(self, image: View) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
        """Keyframes ``(M,)``, rows of their corners and of the image's ``(M, 2)``, and points in the map ``(M, 3)``."""
        keyframes, rows, points = [np.zeros(0, np.intp)], [np.zeros((0, 2), np.intp)], [np.zeros((0, 3))]
        for keyframe in self._index.nearest(image, _PLACES_TRIED):
            view = self._views[keyframe]
            pairs = np.column_stack(matches(view, image, OF_KEYFRAMES))
            pairs = pairs[np.isfinite(view.points[pairs[:, 0]]).all(axis=1)]
            keyframes.append(np.full(len(pairs), keyframe))
            rows.append(pairs)
            points.append(apply(self._T_map_camera[keyframe], view.points[pairs[:, 0]].astype(np.float64)))
        return np.concatenate(keyframes), np.concatenate(rows), np.concatenate(points)
