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
        self._index = PlaceIndex(self._views)
        self._verifier = LoopVerifier(OF_KEYFRAMES, intrinsics, seed=seed)

    def locate(self, image: View) -> tuple[FloatArray, TrackIds, Pixels, int] | None:
        """The pose with most inliers at one of the similar keyframes, and all points that confirm it; None with few.

        Returns:
            ``T_camera_map``, the tracks ``(M,)`` of these points, each once, the pixels ``(M, 2)``
            where the image sees them, and the frame of the keyframe with most of them.
        """
        keyframes, tracks, rows = self._matched(image)
        points, pixels = self.local.points[tracks], image.pixels[rows]
        located: list[Sighting] = []
        for keyframe in np.unique(keyframes):
            here = keyframes == keyframe
            seen = self._verifier.resect(points[here].astype(np.float32), pixels[here])
            if not isinstance(seen, str):
                located.append(seen)
        if not located:
            return None
        best = max(located, key=lambda seen: len(seen.inliers))
        projected = self._intrinsics.project(apply(best.T_camera_points, points))
        residual = np.linalg.norm(projected - pixels, axis=1)
        kept = np.flatnonzero(residual < OF_KEYFRAMES.reprojection_px)
        for once in (rows, tracks):  # each corner and each point
            kept = kept[np.unique(once[kept], return_index=True)[1]]
        if len(kept) < _LEAST_CONFIRMING:
            return None
        place = self.local.keyframes[int(np.bincount(keyframes[kept]).argmax())].index
        return best.T_camera_points, tracks[kept], pixels[kept], place

    def _matched(self, image: View) -> tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.intp]]:
        """Corners of similar keyframes that match those of the image and have points.

        Returns:
            Rows of the keyframes ``(M,)``, tracks of their corners, and rows of the image's.
        """
        keyframes, tracks = [np.zeros(0, np.intp)], [np.zeros(0, np.int64)]
        rows = [np.zeros(0, np.intp)]
        for keyframe in self._index.nearest(image, _PLACES_TRIED):
            corners, corners_image = matches(self._views[keyframe], image, OF_KEYFRAMES)
            own = self.local.keyframes[keyframe].track_ids[corners]
            known = self.local.known(own)
            keyframes.append(np.full(int(known.sum()), keyframe))
            tracks.append(own[known])
            rows.append(corners_image[known])
        return np.concatenate(keyframes), np.concatenate(tracks), np.concatenate(rows)
