"""A submap: the fused voxels of a stretch of road and the views that colour them, as a file.

All submaps share one lattice of blocks in the world, so that a block of two of them is their weighted mean. The
keyframes of ``views`` anchor it: poses that change later by more than a voxel need it fused again from kept keyframes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray
from slam.runtime.errors import RunError
from slam.runtime.storage.archive import reading_archive
from slam.runtime.storage.files import write_atomically

BLOCK_SIDE = 16
BLOCK_VOXELS = BLOCK_SIDE**3

_NAME = re.compile(r"submap_(\d{5})\.npz")


@dataclass(frozen=True)
class Submap:
    """Voxels that were observed, and views.

    ``keys`` ``(B, 3)`` int32 are coordinates of blocks of 16 voxels a side, ``observed`` ``(B, 512)`` the bits of their
    voxels in the order z, y, x; ``tsdf`` ``(S,)`` float16 in truncation distances and ``weight`` ``(S,)`` uint16 belong
    to the observed ones. Of each view: its frame, ``T_world_camera`` ``(K, 4, 4)``, image ``(K, h, w, 3)``, fused depth
    ``(K, h, w)`` float16, 0 where nothing was fused, and ``brightness_steps`` ``(K,)``: the logarithm of its brightness
    over that of the view before, NaN where they share nothing. ``camera`` is fx, fy, cx, cy; ``fused`` counts
    frames; ``voxel_size`` is the side of a voxel.
    """

    keys: NDArray[np.int32]
    observed: NDArray[np.uint8]
    tsdf: NDArray[np.float16]
    weight: NDArray[np.uint16]
    frames: NDArray[np.int64]
    T_world_camera: FloatArray
    images: NDArray[np.uint8]
    depths: NDArray[np.float16]
    brightness_steps: FloatArray
    camera: FloatArray
    fused: NDArray[np.int64]
    voxel_size: FloatArray

    def write(self, path: Path) -> None:
        """Write a file, atomically.

        Raises:
            RunError: it cannot be written.
        """

        def fill(partial: Path) -> None:
            with partial.open("wb") as file:
                np.savez(file, **{each.name: getattr(self, each.name) for each in fields(self)})

        write_atomically(path, fill, RunError)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a whole file.

        Raises:
            RunError: it is missing or damaged.
        """
        with reading_archive(path), np.load(path, allow_pickle=False) as file:
            submap = cls(**{each.name: file[each.name] for each in fields(cls)})
            observed = int(np.unpackbits(submap.observed).sum())
            blocks = len(submap.keys)
            if submap.observed.shape != (blocks, BLOCK_VOXELS // 8) or not observed == len(submap.tsdf):
                raise RunError(f"{path} is damaged (its voxels do not belong to its blocks): run the sequence again")
            return submap

    def blocks(self, chosen: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
        """Observed voxels ``(C, 4096)`` of the chosen ``(B,)`` blocks, and their places in ``tsdf``, in order."""
        counts = np.bitwise_count(self.observed).sum(axis=1, dtype=np.int64)
        begins = np.cumsum(counts) - counts
        begin, count = begins[chosen], counts[chosen]
        shift = np.repeat(begin - (np.cumsum(count) - count), count)
        places = np.arange(count.sum()) + shift
        return np.unpackbits(self.observed[chosen], axis=1).astype(bool), places


def submap_path(folder: Path, number: int) -> Path:
    """The file of the n-th submap."""
    return folder / f"submap_{number:05d}.npz"


def submap_paths(folder: Path) -> list[Path]:
    """The finished submaps in a folder, in their order; none where there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if _NAME.fullmatch(path.name))


def remove_submaps(folder: Path) -> None:
    """Remove the submaps of a folder, and the folder where nothing else is in it."""
    for path in submap_paths(folder):
        path.unlink()
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
