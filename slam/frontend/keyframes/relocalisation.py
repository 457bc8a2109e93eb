"""Relocalisation: a lost camera is found again among the keyframes of its map.

Its corners are matched with those of similar keyframes that have points in the map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.frames import Intrinsics, View
from slam.frontend.keyframes.local_map import LocalMap, TrackIds
from slam.frontend.tracking import Pixels
from slam.geometry.se3 import FloatArray, apply
from slam.loops.verification import OF_KEYFRAMES, LoopVerifier, Sighting, matches
from slam.loops.vocabulary import PlaceIndex

_PLACES_TRIED = 6
# a single image has no points of its own that would confirm the pose, so it takes twice those of a
# loop
_LEAST_CONFIRMING = 30


class Relocaliser:
    """Finds single images among the keyframes of one map."""

    def __init__(self, local: LocalMap, intrinsics: Intrinsics, seed: int = 0) -> None:
        """Index the keyframes of the map, at least one; ``seed`` is that of RANSAC."""
        self.local = local
        self._intrinsics = intrinsics
        self._views = local.views(local.points)
        self._T_map_camera = local.T_world_camera
        self._index = PlaceIndex(self._views)
        self._verifier = LoopVerifier(OF_KEYFRAMES, intrinsics, seed=seed)

    def locate(self, image: View) -> tuple[FloatArray, TrackIds, Pixels, int] | None:
        """The pose with most inliers at one of the similar keyframes, and all points that confirm it; None with few.

        Returns:
            ``T_camera_map``, the tracks ``(M,)`` of these points, each once, the pixels ``(M, 2)``
            where the image sees them, and the frame of the keyframe with most of them.
        """
        keyframes, rows, points = self._matched(image)
        located: list[Sighting] = []
        for keyframe in np.unique(keyframes):
            here = keyframes == keyframe
            pixels = image.pixels[rows[here, 1]]
            seen = self._verifier.resect(points[here].astype(np.float32), pixels)
            if not isinstance(seen, str):
                located.append(seen)
        if not located:
            return None
        best = max(located, key=lambda seen: len(seen.inliers))
        X = apply(best.T_camera_points, points)
        ahead = X[:, 2] > 0
        X[~ahead, 2] = 1.0
        residual = np.linalg.norm(self._intrinsics.project(X) - image.pixels[rows[:, 1]], axis=1)
        kept = np.flatnonzero(ahead & (residual < OF_KEYFRAMES.reprojection_px))
        _, first = np.unique(rows[kept, 1], return_index=True)
        kept = kept[first]
        if len(kept) < _LEAST_CONFIRMING:
            return None
        tracks = np.empty(len(kept), np.int64)
        for keyframe in np.unique(keyframes[kept]):
            here = keyframes[kept] == keyframe
            tracks[here] = self.local.keyframes[keyframe].track_ids[rows[kept[here], 0]]
        tracks, once = np.unique(tracks, return_index=True)
        place = self.local.keyframes[int(np.bincount(keyframes[kept]).argmax())].index
        return best.T_camera_points, tracks, image.pixels[rows[kept[once], 1]], place

    def _matched(self, image: View) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
        """Corners of similar keyframes that match those of the image and have points.

        Returns:
            Rows of the keyframes ``(M,)``, rows of their corners and of the image's ``(M, 2)``, and
            the points in the map ``(M, 3)``.
        """
        keyframes = [np.zeros(0, np.intp)]
        rows = [np.zeros((0, 2), np.intp)]
        points = [np.zeros((0, 3))]
        for keyframe in self._index.nearest(image, _PLACES_TRIED):
            view = self._views[keyframe]
            pairs = np.column_stack(matches(view, image, OF_KEYFRAMES))
            pairs = pairs[np.isfinite(view.points[pairs[:, 0]]).all(axis=1)]
            seen = view.points[pairs[:, 0]].astype(np.float64)
            keyframes.append(np.full(len(pairs), keyframe))
            rows.append(pairs)
            points.append(apply(self._T_map_camera[keyframe], seen))
        return np.concatenate(keyframes), np.concatenate(rows), np.concatenate(points)
