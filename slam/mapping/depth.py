"""The depth of keyframes that is fused: refined by their neighbours at the optimised poses (`erfsfm.mvs`) and filtered.

Each filter has a name, settings, and the share of pixels that it took.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from erfsfm.mvs.refine import Decide, RefinedDepth, measure
from erfsfm.mvs.views import Appearance, neighbours_around
from slam.config.sections import MappingConfig
from slam.frames import DepthMap, Image, Intrinsics, Mask
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray, invert

# chosen on simulated streets and on drive 0013, see docs/design/map.md
_CERTAIN_SIGMA = 0.06  # of depth that is fused beyond the largest depth, over that
_BORDER = 0.02  # left, right and above, over the image's width
_SKY_BRIGHTNESS = 245  # least level of all colours of sky
_SKY_BLUENESS = 15  # or least blue less red of such a pixel, grey levels
_MAX_DEPTH_RATIO = 1.12  # largest ratio of neighbouring pixels of one surface
_MAX_DEPTH_DIFFERENCE = 0.1  # relative, to the depth of a neighbouring keyframe
_OUTSIDE = -9.0  # a column left of every image
_DARK_BLUE = 110  # grey levels below which nothing is the sky by day
_MOST_SIGMA = 1e3  # relative, in place of infinity where depth is unknown
MOST_RELATIVE_SIGMA = 0.3  # of fused depth, over it: beyond that a network guesses, as where a camera turns on the spot
_EXACT = 0.01  # relative sigma below which depth is not a network's: border, sky and edges are not in doubt
_BEHIND = 1.2  # depth that an earlier view sees over that of a thing which was not there yet
_PIECE = np.ones((5, 5), np.uint8)  # pixels of the least such thing: at edges, depth is blurred
FILTERS = ("unknown", "border", "sky", "range", "sigma", "edge", "agreement", "moving")
_REMEMBERED = 24


@dataclass(frozen=True)
class KeyframeDepth:
    """A frame to fuse: depth ``(H, W)``, not positive where unknown, its relative sigma or None, its image and pose.

    ``network_depth`` ``(H, W)`` is the network's own, None where that is the depth to fuse.
    """

    frame: int
    depth: DepthMap
    relative_sigma: DepthMap | None
    image: Image
    T_world_camera: FloatArray
    network_depth: DepthMap | None = None


class DepthFilters:
    """The filters of one camera, in the order of ``FILTERS``."""

    def __init__(self, config: MappingConfig, intrinsics: Intrinsics) -> None:
        """For depth maps of the size of the intrinsics."""
        self._config, self._camera = config, intrinsics
        # (3, H*W) with z = 1
        self._rays = np.ascontiguousarray(
            intrinsics.rays(intrinsics.pixel_grid()).reshape(-1, 3).T, dtype=np.float32
        )
        height, width = intrinsics.height, intrinsics.width
        border = round(_BORDER * width)
        self._top_rows = border + 1
        self._inside = np.zeros((height, width), dtype=bool)
        self._inside[border:, border : width - border] = True
        self._taken = np.zeros(len(FILTERS))
        self._frames = 0

    def shares(self) -> dict[str, float]:
        """The share of the pixels that each filter removed, over the pixels that reached it."""
        return dict(zip(FILTERS, (self._taken / max(self._frames, 1)).tolist(), strict=True))

    def kept(
        self,
        view: KeyframeDepth,
        others: Sequence[KeyframeDepth],
        earlier: KeyframeDepth | None = None,
    ) -> DepthMap:
        """The depth to fuse ``(H, W)``, 0 elsewhere.

        Args:
            view: to be fused.
            others: the views beside it, which see the same place from other positions.
            earlier: some time before: what it sees through has come there since.
        """
        config, depth = self._config, view.depth
        everything = np.ones(depth.shape, dtype=bool)
        sigma = np.full_like(depth, np.nan) if view.relative_sigma is None else view.relative_sigma
        is_exact = sigma < _EXACT
        is_sure = depth * np.minimum(sigma, _MOST_SIGMA) <= _CERTAIN_SIGMA * config.depth_max_m
        farthest = np.where(is_sure, config.reach_m, config.depth_max_m)
        masks = (
            depth > 0,
            self._inside | is_exact,
            ~self._is_sky(view.image) | is_exact,
            (depth >= config.depth_min_m) & (depth < farthest),
            ~(sigma > MOST_RELATIVE_SIGMA),  # where none is stated, too
            ~_at_edges(self.trusted(view)) | is_exact,
            np.any([self._agrees(view, other) for other in others], axis=0)
            if others
            else everything,
            everything if earlier is None else ~self._is_seen_through(view, earlier),
        )
        left = everything
        for number, mask in enumerate(masks):
            self._taken[number] += np.count_nonzero(left & ~mask) / depth.size
            left = left & mask
        self._frames += 1
        return np.where(left, depth, np.float32(0))

    def trusted(self, view: KeyframeDepth) -> DepthMap:
        """Depth with 0 where its sigma is too large."""
        if view.relative_sigma is None:
            return view.depth
        return np.where(view.relative_sigma <= MOST_RELATIVE_SIGMA, view.depth, np.float32(0))

    def projected(
        self, view: KeyframeDepth, other: KeyframeDepth
    ) -> tuple[DepthMap, DepthMap, DepthMap]:
        """Columns, rows and depth ``(H, W)`` of a view's pixels in the other; unknown ones lie outside of it."""
        T_other_camera = (invert(other.T_world_camera) @ view.T_world_camera).astype(np.float32)
        K = self._camera.K.astype(np.float32)
        turned, moved = K @ T_other_camera[:3, :3] @ self._rays, K @ T_other_camera[:3, 3]
        x, y, z = (
            row.reshape(view.depth.shape) * view.depth + m
            for row, m in zip(turned, moved, strict=True)
        )
        ahead = (z > 1e-3) & (view.depth > 0)
        before = np.where(ahead, z, np.float32(1))
        return np.where(ahead, x / before, np.float32(_OUTSIDE)), y / before, z

    def _is_sky(self, image: Image) -> Mask:
        """Bright or blue pixels ``(H, W)`` above the horizon of a level camera, in one piece with the upper border.

        A facade and its windows may be as bright or blue, but have a roof above them.
        """
        horizon = int(np.clip(self._camera.cy, 0, image.shape[0]))
        sky = np.zeros(image.shape[:2], dtype=bool)
        if not horizon:
            return sky
        red, green, blue = (each.astype(np.int16) for each in cv2.split(image[:horizon]))
        is_blue = (blue - red >= _SKY_BLUENESS) & (blue > _DARK_BLUE)
        sky[:horizon] = (cv2.min(cv2.min(red, green), blue) >= _SKY_BRIGHTNESS) | is_blue
        pieces, piece = cv2.connectedComponents(sky.view(np.uint8), connectivity=4)
        is_above = np.zeros(pieces, dtype=bool)
        is_above[piece[: self._top_rows]] = True
        found: Mask = sky & is_above[piece]
        return found

    def _agrees(self, view: KeyframeDepth, other: KeyframeDepth) -> Mask:
        """Pixels ``(H, W)`` whose depth is consistent with the other view's depth."""
        u, v, z = self.projected(view, other)
        there = sampled(self.trusted(other), u, v)
        return np.abs(there - z) < np.float32(_MAX_DEPTH_DIFFERENCE) * z

    def _is_seen_through(self, view: KeyframeDepth, earlier: KeyframeDepth) -> Mask:
        """Pixels ``(H, W)`` of pieces behind which the earlier view sees something."""
        u, v, z = self.projected(view, earlier)
        behind = sampled(self.trusted(earlier), u, v) > np.float32(_BEHIND) * z
        return np.asarray(
            cv2.morphologyEx(behind.view(np.uint8), cv2.MORPH_OPEN, _PIECE), dtype=bool
        )


def sampled(image: NDArray[Any], u: DepthMap, v: DepthMap) -> NDArray[Any]:
    """The pixels of an image nearest to columns and rows ``(H, W)``, 0 outside of it."""
    return cv2.remap(image, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def _at_edges(depth: DepthMap) -> Mask:
    """Pixels on either side of a relative depth step, where networks blur depth."""
    beside = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    nearest, farthest = cv2.erode(depth, beside), cv2.dilate(depth, beside)
    return (farthest > _MAX_DEPTH_RATIO * depth) | (depth > _MAX_DEPTH_RATIO * nearest)


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
        chosen = neighbours_around(self._T_world_camera, n, median(depth[~unknown]), self._indices)
        if not chosen:
            return None
        if unknown.any():
            nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
            depth = depth[tuple(nearest)]
        T_neighbour_target = invert(self._T_world_camera[chosen]) @ self._T_world_camera[n]
        target, others = self._appearance(n), [self._appearance(k) for k in chosen]
        measurement = measure(target, depth, others, self._intrinsics.K, T_neighbour_target)
        refined = self._decide(measurement)
        refined.relative_sigma[unknown & ~refined.measured] = np.inf
        return refined
