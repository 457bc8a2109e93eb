"""Depth maps beside the images of a recording: 16-bit PNG, 0 where unknown."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from erfsfm.common.errors import DataError
from erfsfm.common.readers.images import read_values
from erfsfm.common.readers.numbering import NumberedFiles
from slam.geometry.se3 import FloatArray

KITTI_PER_METRE = 256.0


@dataclass(frozen=True)
class DepthMaps:
    """Files by frame, the stored value of one metre, and perhaps a value other than 0 where depth is unknown."""

    paths: dict[int, Path]
    per_metre: float = KITTI_PER_METRE
    unknown: int = 0

    def read(self, index: int) -> FloatArray:
        """The depth map ``(h, w)`` of a frame in metres.

        Raises:
            DataError: it cannot be read, or is no 16-bit grey image.
        """
        path = self.paths[index]
        values = read_values(path)
        if values.ndim != 2 or values.dtype != np.uint16:
            raise DataError(f"depth map {path} is no 16-bit grey PNG: write it again, or remove the folder")
        return np.where(values == self.unknown, 0, values) / self.per_metre


def depth_maps_of(paths: list[Path], per_metre: float, unknown: int = 0) -> DepthMaps | None:
    """The depth maps of the frames whose files are there; None where there are none."""
    found = {row: path for row, path in enumerate(paths) if path.is_file()}
    return DepthMaps(found, per_metre, unknown) if found else None


def depth_maps_in(folder: Path, images: NumberedFiles) -> DepthMaps | None:
    """The depth maps of a folder, by the numbers of the images; None where there are none."""
    found = (path for path in folder.glob("*.png") if path.stem.isdecimal()) if folder.is_dir() else ()
    paths = {int(path.stem) - images.first: path for path in found}
    return DepthMaps(paths) if paths else None
