"""Fusion of depth maps into one ``VoxelBlockGrid`` (Curless and Levoy 1996), without colour."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.frames import DepthMap, Intrinsics
from slam.geometry.se3 import FloatArray, invert
from slam.mapping.submap import BLOCK_SIDE, BLOCK_VOXELS
from slam.runtime.imports import import_open3d

SEED_STRIDE = 4  # Open3D activates blocks at these pixels only, and raises where none of them has depth
_CAPACITY = 1000  # blocks of 32 KiB; growing takes Open3D a moment
_MOST_WEIGHT = np.iinfo(np.uint16).max


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

    def __init__(self, voxel_size_m: float, truncation_voxels: float, reach_m: float, camera: Intrinsics) -> None:
        """An empty submap of depth maps of this camera; depth beyond ``reach_m`` is not fused."""
        self._grid = new_grid(voxel_size_m)
        self._truncation, self._reach = truncation_voxels, reach_m
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
        how = (self._K, T_camera_world, 1.0, self._reach, self._truncation)
        self._grid.integrate(self._grid.compute_unique_block_coordinates(image, *how), image, *how)
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
