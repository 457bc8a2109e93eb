"""Submaps: the fused voxels of stretches of road and the views that colour them, and their weighted mean.

All submaps share one lattice of blocks in the world. Depth maps are fused as by Curless and Levoy (1996).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.frames import DepthMap, Intrinsics
from slam.geometry.se3 import FloatArray, invert
from slam.runtime.imports import import_open3d
from slam.runtime.resources import SpilledArray, SpillFile

BLOCK_SIDE = 16
BLOCK_VOXELS = BLOCK_SIDE**3
TILE_BLOCKS = 16
SEED_STRIDE = 4  # Open3D activates blocks at these pixels only, and raises where none of them has depth
TRUNCATION_VOXELS = 10.0  # of the signed distance: 4 lose completeness, 12 accuracy (docs/design/tried-without-success)
_CAPACITY = 1000  # blocks of 32 KiB; growing takes Open3D a moment
_MOST_WEIGHT = np.iinfo(np.uint16).max
_REMEMBERED = 4  # submaps; neighbouring tiles need the same ones

Keys = NDArray[np.int64]
SpilledSubmap = dict[str, SpilledArray]  # the fields of a `Submap` on disk


@dataclass(frozen=True)
class Submap:
    """Voxels that were observed, and views.

    ``keys`` ``(B, 3)`` int32 are coordinates of blocks of 16 voxels a side, ``observed`` ``(B, 512)`` the bits of their
    voxels in the order z, y, x; ``tsdf`` ``(S,)`` float16 in truncation distances and ``weight`` ``(S,)`` uint16 belong
    to the observed ones. Of each view: ``T_world_camera`` ``(K, 4, 4)``, image ``(K, h, w, 3)``, fused depth
    ``(K, h, w)`` float16, 0 where nothing was fused, and ``brightness_steps`` ``(K,)``: the logarithm of its brightness
    over that of the view before, NaN where they share nothing. ``camera`` is fx, fy, cx, cy.
    """

    keys: NDArray[np.int32]
    observed: NDArray[np.uint8]
    tsdf: NDArray[np.float16]
    weight: NDArray[np.uint16]
    T_world_camera: FloatArray
    images: NDArray[np.uint8]
    depths: NDArray[np.float16]
    brightness_steps: FloatArray
    camera: FloatArray

    def spilled(self, file: SpillFile) -> SpilledSubmap:
        """The same on disk.

        Raises:
            SlamError: the disk is full.
        """
        return {each.name: file.put(getattr(self, each.name)) for each in fields(self)}

    def blocks(self, chosen: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
        """Observed voxels ``(C, 4096)`` of the chosen ``(B,)`` blocks, and their places in ``tsdf``, in order."""
        counts = np.bitwise_count(self.observed).sum(axis=1, dtype=np.int64)
        begins = np.cumsum(counts) - counts
        begin, count = begins[chosen], counts[chosen]
        shift = np.repeat(begin - (np.cumsum(count) - count), count)
        places = np.arange(count.sum()) + shift
        return np.unpackbits(self.observed[chosen], axis=1).astype(bool), places

    @classmethod
    def read(cls, spilled: SpilledSubmap) -> Submap:
        """A submap from disk."""
        return cls(**{name: array.read() for name, array in spilled.items()})


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
        self.length += 0.0 if self._position is None else float(np.linalg.norm(position - self._position))
        self._position = position
        return True

    def observed(
        self,
    ) -> tuple[NDArray[np.int32], NDArray[np.uint8], NDArray[np.float16], NDArray[np.uint16]]:
        """Keys, bits of observed voxels, their distances and weights, as in `Submap`, in the order of the keys."""
        places = self._grid.hashmap().active_buf_indices().numpy().astype(np.int64)
        keys = self._grid.hashmap().key_tensor().numpy()[places]
        order = np.lexsort(keys.T)  # that of Open3D's threads is not reproducible
        weight = self._grid.attribute("weight").numpy().reshape(-1, BLOCK_VOXELS)[places[order]]
        seen = weight > 0
        tsdf = self._grid.attribute("tsdf").numpy().reshape(-1, BLOCK_VOXELS)[places[order]][seen]
        weights = np.minimum(weight[seen], _MOST_WEIGHT).astype(np.uint16)
        return keys[order], np.packbits(seen, axis=1), tsdf.astype(np.float16), weights


class MergedSubmaps:
    """Submaps on disk; of each the block coordinates and the views' poses stay in memory."""

    def __init__(self, submaps: Sequence[SpilledSubmap]) -> None:
        """Read what stays in memory of at least one submap."""
        self._keys: list[Keys] = [submap["keys"].read().astype(np.int64) for submap in submaps]
        poses, steps = ([submap[name].read() for submap in submaps] for name in ("T_world_camera", "brightness_steps"))
        self.T_world_views: FloatArray = np.concatenate(poses)
        self.brightness_steps: FloatArray = np.concatenate(steps)
        self.submap_of_view = np.repeat(np.arange(len(submaps)), [len(each) for each in steps])
        self.count = len(self._keys)
        self.read = lru_cache(maxsize=_REMEMBERED)(lambda number: Submap.read(submaps[number]))

    def tiles(self) -> Keys:
        """Coordinates ``(N, 3)`` of the cubes of 16 blocks a side in which anything was observed, along the drive."""
        tiles = np.concatenate([keys // TILE_BLOCKS for keys in self._keys])
        _, first = np.unique(tiles, axis=0, return_index=True)
        return tiles[np.sort(first)]

    def block_count(self) -> int:
        """Number of different blocks."""
        return len(np.unique(np.concatenate(self._keys), axis=0))

    def merged(self, low: Keys, high: Keys) -> tuple[Keys, NDArray[np.float32], NDArray[np.float32]]:
        """Blocks with ``low <= key < high``: the weighted means of the blocks of all submaps.

        Coordinates ``(B, 3)``, distances ``(B, 4096)`` in truncation distances, and weights ``(B, 4096)``.
        """
        inside = [np.asarray(((keys >= low) & (keys < high)).all(axis=1)) for keys in self._keys]
        keys = np.unique(np.concatenate([own[mask] for own, mask in zip(self._keys, inside)]), axis=0)
        weight = np.zeros((len(keys), BLOCK_VOXELS), np.float32)
        total = np.zeros_like(weight)
        for number, mask in enumerate(inside):
            if not mask.any():
                continue
            submap = self.read(number)
            rows = _rows(keys, self._keys[number][mask], low, high)
            observed, places = submap.blocks(mask)
            own = np.zeros(observed.shape, np.float32)
            own[observed] = submap.weight[places]
            weight[rows] += own
            own[observed] *= submap.tsdf[places]
            total[rows] += own
        np.divide(total, weight, out=total, where=weight > 0)
        return keys, total, weight


def _rows(keys: Keys, wanted: Keys, low: Keys, high: Keys) -> NDArray[np.intp]:
    """Where each of the wanted keys is among sorted, different keys."""
    size = high - low

    def flat(k: Keys) -> NDArray[np.int64]:
        x, y, z = (k - low).T
        number: NDArray[np.int64] = (x * size[1] + y) * size[2] + z
        return number

    return np.searchsorted(flat(keys), flat(wanted))
