"""Submaps: the fused voxels of stretches of road and the views that colour them, and their weighted mean.

All submaps share one lattice of blocks in the world. Depth maps are fused as by Curless and Levoy (1996). Colours are
of the sharpest keyframe of every stretch, with the exposures evened out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.spatial import cKDTree

from slam.config.sections import MappingConfig
from slam.frames import DepthMap, Image, Intrinsics
from slam.geometry.robust import difference_equations, median
from slam.geometry.se3 import FloatArray, apply, invert, length_of, rotation_angle
from slam.mapping.depth import DepthFilters, KeyframeDepth, sampled
from slam.runtime.imports import import_open3d
from slam.runtime.memory import Spilled

Keys = NDArray[np.int64]
SpilledSubmap = dict[str, Spilled]  # the fields of a `Submap` on disk

BLOCK_SIDE = 16
BLOCK_VOXELS = BLOCK_SIDE**3
TILE_BLOCKS = 16
# Open3D activates blocks at these pixels only, and raises where none of them has depth
SEED_STRIDE = 4
TRUNCATION_VOXELS = 10.0  # of the signed distance: 4 lose completeness, 12 accuracy (docs/design/tried-without-success)
_CAPACITY = 1000  # blocks of 32 KiB; growing takes Open3D a moment
_MOST_WEIGHT = np.iinfo(np.uint16).max
_REMEMBERED = 4  # submaps; neighbouring tiles need the same ones
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


@dataclass(frozen=True)
class Submap:
    """Voxels that were observed, and views.

    ``keys`` ``(B, 3)`` int32 are coordinates of blocks of 16 voxels a side. Of their voxels in the order z, y, x:
    ``tsdf`` ``(B, 4096)`` float16 in truncation distances, and ``weight`` ``(B, 4096)`` uint16, 0 where nothing was
    observed. Of each view: ``T_world_camera`` ``(K, 4, 4)``, image ``(K, h, w, 3)``, fused depth ``(K, h, w)`` float16,
    0 where nothing was fused, and ``brightness_steps`` ``(K, 3)`` by `_brightness_step`.
    """

    keys: NDArray[np.int32]
    tsdf: NDArray[np.float16]
    weight: NDArray[np.uint16]
    T_world_camera: FloatArray
    images: NDArray[np.uint8]
    depths: NDArray[np.float16]
    brightness_steps: FloatArray


def new_grid(voxel_size_m: float, capacity: int = _CAPACITY) -> Any:
    """An empty grid of signed distances and weights."""
    o3d = import_open3d()
    kind, device = o3d.core.float32, o3d.core.Device("CPU:0")
    kinds, channels = (kind, kind), ((1), (1))
    return o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), kinds, channels, voxel_size_m, BLOCK_SIDE, capacity, device
    )


class Fusion:
    """The voxels of one submap."""

    def __init__(self, voxel_size_m: float, reach_m: float, camera: Intrinsics) -> None:
        """An empty submap of depth maps of this camera; depth beyond ``reach_m`` is not fused."""
        self._grid = new_grid(voxel_size_m)
        self._reach = reach_m
        self.length = 0.0  # of the way between fused frames
        self._position: FloatArray | None = None
        K = camera.K
        # Open3D truncates projected pixels where we round them: its pixel centres are at (0.5, 0.5)
        K[:2, 2] += 0.5
        self._K = import_open3d().core.Tensor(K)

    @property
    def blocks(self) -> int:
        """Number of blocks so far."""
        return int(self._grid.hashmap().size())

    def integrate(self, depth: DepthMap, T_world_camera: FloatArray) -> bool:
        """Fuse a depth map ``(H, W)``, 0 where nothing is known; False where hardly anything is."""
        rows, columns = (side // SEED_STRIDE * SEED_STRIDE for side in depth.shape)
        if not depth[:rows:SEED_STRIDE, :columns:SEED_STRIDE].any():
            return False
        o3d = import_open3d()
        image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth)))
        T_camera_world = o3d.core.Tensor(invert(T_world_camera))  # what Open3D calls extrinsic
        how = (self._K, T_camera_world, 1.0, self._reach, TRUNCATION_VOXELS)
        self._grid.integrate(self._grid.compute_unique_block_coordinates(image, *how), image, *how)
        position = T_world_camera[:3, 3]
        self.length += 0.0 if self._position is None else length_of(position - self._position)
        self._position = position
        return True

    def observed(self) -> dict[str, NDArray[Any]]:
        """Keys, distances and weights, as fields of a `Submap`, in order of the keys."""
        places = self._grid.hashmap().active_buf_indices().numpy().astype(np.int64)
        keys = self._grid.hashmap().key_tensor().numpy()[places]
        order = np.lexsort(keys.T)  # that of Open3D's threads is not reproducible
        tsdf, weight = (
            self._grid.attribute(name).numpy().reshape(-1, BLOCK_VOXELS)[places[order]]
            for name in ("tsdf", "weight")
        )
        return {
            "keys": keys[order],
            "tsdf": tsdf.astype(np.float16),
            "weight": np.minimum(weight, _MOST_WEIGHT).astype(np.uint16),
        }


class MergedSubmaps:
    """Submaps on disk; of each the block coordinates and the views' poses stay in memory."""

    def __init__(self, submaps: Sequence[SpilledSubmap]) -> None:
        """Read what stays in memory of at least one submap."""
        self._keys: list[Keys] = [submap["keys"]().astype(np.int64) for submap in submaps]
        poses = [submap["T_world_camera"]() for submap in submaps]
        steps = [submap["brightness_steps"]() for submap in submaps]
        self.T_world_views: FloatArray = np.concatenate(poses)
        self.brightness_steps: FloatArray = np.concatenate(steps)
        self.submap_of_view = np.repeat(np.arange(len(submaps)), [len(each) for each in steps])
        self.count = len(self._keys)
        self.blocks = len(np.unique(np.concatenate(self._keys), axis=0))

        @lru_cache(maxsize=_REMEMBERED)
        def read(number: int) -> Submap:
            return Submap(**{name: array() for name, array in submaps[number].items()})

        self.read = read

    def tiles(self) -> Keys:
        """Coordinates ``(N, 3)`` of the cubes of 16 blocks a side in which anything was observed, along the drive."""
        tiles = np.concatenate([keys // TILE_BLOCKS for keys in self._keys])
        _, first = np.unique(tiles, axis=0, return_index=True)
        return tiles[np.sort(first)]

    def merged(
        self, low: Keys, high: Keys
    ) -> tuple[Keys, NDArray[np.float32], NDArray[np.float32]]:
        """Blocks with ``low <= key < high``: the weighted means of the blocks of all submaps.

        Coordinates ``(B, 3)``, distances ``(B, 4096)`` in truncation distances, and weights ``(B, 4096)``.
        """
        inside = [np.asarray(((keys >= low) & (keys < high)).all(axis=1)) for keys in self._keys]
        parts = [own[mask] for own, mask in zip(self._keys, inside)]
        keys, rows = np.unique(np.concatenate(parts), axis=0, return_inverse=True)
        weight = np.zeros((len(keys), BLOCK_VOXELS), np.float32)
        total = np.zeros_like(weight)
        ends = np.cumsum([len(part) for part in parts])
        for number, own_rows in enumerate(np.split(rows.ravel(), ends[:-1])):
            if not len(own_rows):
                continue
            submap, mask = self.read(number), inside[number]
            own = submap.weight[mask].astype(np.float32)
            weight[own_rows] += own
            total[own_rows] += own * submap.tsdf[mask]
        np.divide(total, weight, out=total, where=weight > 0)
        return keys, total, weight


class ViewChooser:
    """Chooses the views of one submap after the other."""

    def __init__(self, filters: DepthFilters, depth_max_m: float) -> None:
        """Of the camera of these filters; ``depth_max_m`` is the largest fused depth."""
        self._filters, self._step_m = filters, _STEP * depth_max_m
        self._chosen: list[KeyframeDepth] = []
        self._steps: list[FloatArray] = []
        self._begin: FloatArray | None = None
        self._best: tuple[float, KeyframeDepth] | None = None  # with its sharpness
        self._last: KeyframeDepth | None = None

    def add(self, view: KeyframeDepth, kept: DepthMap) -> None:
        """A fused frame with the depth that passed the filters."""
        if self._begin is not None and has_moved(
            view.T_world_camera, self._begin, self._step_m, _STEP_DEG
        ):
            self._close()
        if self._begin is None:
            self._begin = view.T_world_camera
        grey = _grey(view.image)
        # contrast does not count
        sharpness = float(cv2.Laplacian(grey, cv2.CV_64F).var() / (grey.var() + 1.0))
        if self._best is None or sharpness > self._best[0]:
            self._best = sharpness, replace(view, depth=kept, relative_sigma=None)

    def take(self) -> dict[str, NDArray[Any]]:
        """The views since the last call, at least one, as fields of a `Submap`."""
        self._close()
        views, steps = self._chosen, self._steps
        self._chosen, self._steps = [], []
        return {
            "T_world_camera": np.array([view.T_world_camera for view in views]),
            "images": np.array([view.image for view in views]),
            "depths": np.array([view.depth for view in views], dtype=np.float16),
            "brightness_steps": np.array(steps),
        }

    def _close(self) -> None:
        if self._best is not None:
            _, view = self._best
            self._steps.append(
                np.full(3, np.nan)
                if self._last is None
                else self._brightness_step(view, self._last)
            )
            self._chosen.append(view)
            self._last = view
        self._begin = self._best = None

    def _brightness_step(self, view: KeyframeDepth, before: KeyframeDepth) -> FloatArray:
        """How the surfaces that two views share change from the one before ``(3,)``, NaN where they share too few.

        The logarithm of their brightness, how much further from the middle they are seen (`_outwards`),
        and the slope of the first over the second: surfaces that come nearer move outwards, where a
        lens darkens the image, which is no change of exposure.
        """
        u, v, z = self._filters.projected(view, before)
        same = np.abs(sampled(before.depth, u, v) - z) < _SAME_SURFACE * z
        rows, columns = (each[::_STRIDE] for each in np.nonzero(same))
        here = _grey(view.image)[rows, columns]
        there = sampled(_grey(before.image), u, v)[rows, columns]
        u, v = u[rows, columns], v[rows, columns]
        moved = _outwards(columns, rows, same.shape) - _outwards(u, v, same.shape)
        usable = (np.minimum(here, there) > _DARK) & (np.maximum(here, there) < _BRIGHT)
        if usable.sum() < _LEAST_SHARED:
            return np.full(3, np.nan)
        change, moved = np.log(here[usable] / there[usable]), moved[usable]
        far = moved > np.median(moved)
        rise, run = (np.median(each[far]) - np.median(each[~far]) for each in (change, moved))
        return np.array([np.median(change), np.median(moved), rise / max(run, 1e-3)])


def has_moved(
    T_world_camera: FloatArray, T_world_before: FloatArray, step_m: float, turn_deg: float
) -> bool:
    """Whether a camera has moved by a step or a turn.

    Args:
        T_world_camera: its pose now ``(4, 4)``.
        T_world_before: its pose before ``(4, 4)``.
        step_m: the least length of a step.
        turn_deg: the least angle of a turn.
    """
    T_before_camera = invert(T_world_before) @ T_world_camera
    turned = float(rotation_angle(T_before_camera[:3, :3]))
    return length_of(T_before_camera[:3, 3]) >= step_m or turned >= np.deg2rad(turn_deg)


def moved_rows(T_world_camera: FloatArray, step_m: float, turn_deg: float) -> list[int]:
    """The first of some poses ``(N, 4, 4)``, and each before which the camera has moved since the last chosen one."""
    chosen: list[int] = []
    for row, T_next in enumerate(T_world_camera):
        if not chosen or has_moved(T_next, T_world_camera[chosen[-1]], step_m, turn_deg):
            chosen.append(row)
    return chosen


def _outwards(u: NDArray[Any], v: NDArray[Any], shape: tuple[int, ...]) -> FloatArray:
    """Squared distance of pixels ``(M,)`` from the middle of an image ``(h, w)``, in half its width."""
    height, width = shape[:2]
    x, y = 2.0 * u - width + 1.0, 2.0 * v - height + 1.0
    return np.asarray((x**2 + y**2) / width**2, np.float64)


def _grey(image: Image) -> FloatArray:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.float64)


class Painter:
    """Colours points by the views of all submaps."""

    def __init__(self, submaps: MergedSubmaps, config: MappingConfig, camera: Intrinsics) -> None:
        """Even out the exposure of all views by one camera, and what its lens darkens."""
        self._submaps, self._config, self._camera = submaps, config, camera
        steps, outwards, slopes = submaps.brightness_steps.T
        known = slopes[np.isfinite(slopes)]
        self._darkening = median(known) if len(known) else 0.0
        self._gains = np.exp(-evened(steps - self._darkening * outwards))

    def colours(self, points_world: FloatArray) -> NDArray[np.uint8]:
        """RGB ``(P, 3)`` of points of the surface ``(P, 3)``; one that no view shows has that of the nearest shown."""
        total, weight = np.zeros((len(points_world), 3)), np.zeros(len(points_world))
        low, high = points_world.min(axis=0), points_world.max(axis=0)
        positions = self._submaps.T_world_views[:, :3, 3]
        away = np.linalg.norm(positions - np.clip(positions, low, high), axis=1)
        for view in np.flatnonzero(away < self._config.reach_m):
            self._add(int(view), points_world, total, weight)
        shown = weight > 0
        if not shown.any():
            return np.full(points_world.shape, _GREY, np.uint8)
        colours = total / np.where(shown, weight, 1.0)[:, None]
        if not shown.all():
            _, nearest = cKDTree(points_world[shown]).query(points_world[~shown])
            colours[~shown] = colours[shown][nearest]
        return np.asarray(np.rint(np.clip(colours, 0, 255)), np.uint8)

    def _add(
        self, view: int, points_world: FloatArray, total: FloatArray, weight: FloatArray
    ) -> None:
        """Add the colours of one view to those of the points that it shows."""
        number = int(self._submaps.submap_of_view[view])
        submap = self._submaps.read(number)
        own = view - int(np.searchsorted(self._submaps.submap_of_view, number))
        T_camera_world = invert(self._submaps.T_world_views[view])
        depth_of_points = points_world @ T_camera_world[2, :3] + T_camera_world[2, 3]
        voxel = self._config.voxel_size_m
        ahead = np.flatnonzero(depth_of_points > _NEAREST_VOXELS * voxel)
        points = apply(T_camera_world, points_world[ahead])
        depth, image = submap.depths[own], submap.images[own]
        u, v = np.rint(self._camera.project(points)).T
        inside = (u >= 0) & (u < depth.shape[1]) & (v >= 0) & (v < depth.shape[0])
        u, v = u[inside].astype(np.intp), v[inside].astype(np.intp)
        z, ahead = points[inside, 2], ahead[inside]
        known = depth[v, u]
        nearly = np.maximum(_SAME_VOXELS * voxel, _SAME_SURFACE * z)
        same = (known > 0) & (np.abs(known - z) < nearly)
        shown, share, u, v = ahead[same], z[same] ** -_NEARNESS, u[same], v[same]
        weight[shown] += share
        lens = np.exp(-self._darkening * _outwards(u, v, depth.shape))
        total[shown] += (share * self._gains[view] * lens)[:, None] * image[v, u]


def evened(brightness_steps: FloatArray) -> FloatArray:
    """Logarithms of the brightness ``(N,)`` of views by the steps between them, as small as these allow.

    Least squares; a step that is NaN couples nothing.
    """
    count = len(brightness_steps)
    if count < 2:
        return np.zeros(count)
    steps = brightness_steps[1:]
    known, views = np.isfinite(steps), np.arange(count)
    information, right = difference_equations(
        views[1:],
        views[:-1],
        np.where(known, steps, 0.0),
        known.astype(float),
        np.full(count, _EXPOSURE_PRIOR),
    )
    solved: FloatArray = solveh_banded(information[1:], right)
    return solved
