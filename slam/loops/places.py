"""The localisation map of a run (``places.npz``): features, their 3-D points and the poses they were seen from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from slam.errors import RunError
from slam.frames import Intrinsics
from slam.loops.descriptors import View
from slam.se3 import FloatArray
from slam.storage.archive import reading_archive

PLACES = "places.npz"
_FORMAT = 1


@dataclass(frozen=True)
class Places:
    """Views of one drive, points in the unit of its trajectory; ``T_world_camera`` ``(V, 4, 4)`` row by row."""

    intrinsics: Intrinsics
    views: tuple[View, ...]
    T_world_camera: FloatArray

    def write(self, path: Path) -> None:
        """Write as ``.npz``; ``docs/outputs.md`` describes each array."""
        camera = self.intrinsics
        np.savez_compressed(
            path,
            format=np.array(_FORMAT),
            camera=np.array([camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]),
            frames=np.array([view.index for view in self.views], np.int64),
            counts=np.array([len(view) for view in self.views], np.int64),
            T_world_camera=self.T_world_camera,
            pixels=np.concatenate([np.zeros((0, 2), np.float32), *(view.pixels for view in self.views)]),
            descriptors=np.concatenate([np.zeros((0, 32), np.uint8), *(view.descriptors for view in self.views)]),
            points=np.concatenate([np.zeros((0, 3), np.float32), *(view.points for view in self.views)]),
        )

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read what ``write`` wrote.

        Raises:
            RunError: the file is missing, damaged or of another version.
        """
        with reading_archive(path):
            with np.load(path, allow_pickle=False) as file:
                content = {name: file[name] for name in file.files}
            if int(content["format"]) != _FORMAT:
                raise RunError(f"{path} has format {content['format']}, this version reads {_FORMAT}: run again")
            width, height, *pinhole = content["camera"].tolist()
            frames, ends = content["frames"].tolist(), np.cumsum(content["counts"])
            # the part after the last view is empty
            parts = [np.split(content[name], ends)[: len(frames)] for name in ("pixels", "descriptors", "points")]
            views = tuple(View(index, *arrays) for index, *arrays in zip(frames, *parts, strict=True))
            return cls(Intrinsics(int(width), int(height), *pinhole), views, content["T_world_camera"])
