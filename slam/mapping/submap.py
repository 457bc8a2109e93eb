"""A submap: the fused voxels of a stretch of road and the views that colour them.

All submaps share one lattice of blocks in the world, so that a block of two of them is their weighted mean.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray
from slam.runtime.storage.spill import SpilledArray, SpillFile

BLOCK_SIDE = 16
BLOCK_VOXELS = BLOCK_SIDE**3


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
        return SpilledSubmap({each.name: file.put(getattr(self, each.name)) for each in fields(self)})

    def blocks(self, chosen: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
        """Observed voxels ``(C, 4096)`` of the chosen ``(B,)`` blocks, and their places in ``tsdf``, in order."""
        counts = np.bitwise_count(self.observed).sum(axis=1, dtype=np.int64)
        begins = np.cumsum(counts) - counts
        begin, count = begins[chosen], counts[chosen]
        shift = np.repeat(begin - (np.cumsum(count) - count), count)
        places = np.arange(count.sum()) + shift
        return np.unpackbits(self.observed[chosen], axis=1).astype(bool), places


@dataclass(frozen=True)
class SpilledSubmap:
    """A submap on disk: its fields by name."""

    arrays: dict[str, SpilledArray]

    def read(self) -> Submap:
        """The submap, as it was spilled."""
        return Submap(**{name: array.read() for name, array in self.arrays.items()})
