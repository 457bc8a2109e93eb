"""Keyframes' learned depth refined by their neighbours at the optimised poses (`erfsfm.mvs`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from erfsfm.mvs.refine import Decide, RefinedDepth, measure
from erfsfm.mvs.views import Appearance, neighbours_around
from slam.frames import DepthMap, Image, Intrinsics
from slam.geometry.se3 import FloatArray, invert

_REMEMBERED = 24


class DepthRefiner:
    """Refines keyframes of one drive in time order."""

    def __init__(
        self,
        intrinsics: Intrinsics,
        indices: Sequence[int],
        T_world_camera: FloatArray,
        image: Callable[[int], Image],
        decide: Decide,
    ) -> None:
        """Keyframes of these frame numbers, ascending, at poses ``(K, 4, 4)`` in the unit of the depths to come.

        ``image`` gives that of the n-th keyframe, of these intrinsics; ``decide`` chooses learned or measured depth.
        """
        self._intrinsics = intrinsics
        self._indices = np.asarray(indices)
        self._T_world_camera = T_world_camera
        self._decide = decide

        @lru_cache(maxsize=_REMEMBERED)
        def appearance(n: int) -> Appearance:
            return Appearance.of(np.asarray(cv2.cvtColor(image(n), cv2.COLOR_RGB2GRAY), np.uint8))

        self._appearance = appearance

    def refine(self, n: int, depth: DepthMap) -> RefinedDepth | None:
        """The n-th keyframe's metric depth ``(H, W)``, refined; None where no neighbour is at a useful distance.

        Pixels without depth, as other sources than the networks may have, begin with that of the nearest pixel which
        has one; what the images do not measure there has an infinite sigma.
        """
        unknown = ~(np.isfinite(depth) & (depth > 0))
        if unknown.all():
            return None
        chosen = neighbours_around(self._T_world_camera, n, float(np.median(depth[~unknown])), self._indices)
        if not chosen:
            return None
        if unknown.any():
            nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
            depth = depth[tuple(nearest)]
        T_neighbour_target = invert(self._T_world_camera[chosen]) @ self._T_world_camera[n]
        others = [self._appearance(k) for k in chosen]
        measurement = measure(self._appearance(n), depth, others, self._intrinsics.K, T_neighbour_target)
        refined = self._decide(measurement)
        refined.relative_sigma[unknown & ~refined.measured] = np.inf
        return refined
