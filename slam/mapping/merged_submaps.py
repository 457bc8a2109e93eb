"""The finished submaps of a map: where each block is, and the blocks of a region merged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray
from slam.mapping.submap import BLOCK_VOXELS, SpilledSubmap

TILE_BLOCKS = 16
_REMEMBERED = 4  # submaps; neighbouring tiles need the same ones

Keys = NDArray[np.int64]


@dataclass(frozen=True)
class Blocks:
    """Merged blocks: coordinates ``(B, 3)``, distances ``(B, 4096)`` in truncation distances, weights ``(B, 4096)``."""

    keys: Keys
    tsdf: NDArray[np.float32]
    weight: NDArray[np.float32]


class MergedSubmaps:
    """Submaps on disk; of each the block coordinates and the views' poses stay in memory."""

    def __init__(self, submaps: Sequence[SpilledSubmap]) -> None:
        """Read what stays in memory of at least one submap."""
        self._keys: list[Keys] = [submap.arrays["keys"].read().astype(np.int64) for submap in submaps]
        poses, steps = (
            [submap.arrays[name].read() for submap in submaps] for name in ("T_world_camera", "brightness_steps")
        )
        self.T_world_views: FloatArray = np.concatenate(poses)
        self.brightness_steps: FloatArray = np.concatenate(steps)
        self.submap_of_view = np.repeat(np.arange(len(submaps)), [len(each) for each in steps])
        self.count = len(self._keys)
        self.read = lru_cache(maxsize=_REMEMBERED)(lambda number: submaps[number].read())

    def tiles(self) -> Keys:
        """Coordinates ``(N, 3)`` of the cubes of 16 blocks a side in which anything was observed, along the drive."""
        tiles = np.concatenate([keys // TILE_BLOCKS for keys in self._keys])
        _, first = np.unique(tiles, axis=0, return_index=True)
        return tiles[np.sort(first)]

    def block_count(self) -> int:
        """Number of different blocks."""
        return len(np.unique(np.concatenate(self._keys), axis=0))

    def merged(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> Blocks:
        """Blocks with ``low <= key < high``: the weighted means of the blocks of all submaps."""
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
        return Blocks(keys, total, weight)


def _rows(keys: Keys, wanted: Keys, low: Keys, high: Keys) -> NDArray[np.intp]:
    """Where each of the wanted keys is among sorted, different keys."""
    size = high - low

    def flat(k: Keys) -> NDArray[np.int64]:
        x, y, z = (k - low).T
        number: NDArray[np.int64] = (x * size[1] + y) * size[2] + z
        return number

    return np.searchsorted(flat(keys), flat(wanted))
