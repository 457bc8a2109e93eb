"""The localisation map of a run (``places.npz``): features, their 3-D points and the poses they were seen from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from slam.frames import Intrinsics, View
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import RunError

_FORMAT = 1
_ARRAYS = ("camera", "frames", "counts", "T_world_camera", "pixels", "descriptors", "points")


@dataclass(frozen=True)
class Places:
    """Views of one drive, points in the unit of its trajectory; ``T_world_camera`` ``(V, 4, 4)`` row by row."""

    intrinsics: Intrinsics
    views: tuple[View, ...]
    T_world_camera: FloatArray

    def write(self, path: Path) -> None:
        """Write as ``.npz``; ``docs/localisation.md`` describes each array."""
        camera = self.intrinsics
        np.savez_compressed(
            path,
            format=np.array(_FORMAT),
            camera=np.array([camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]),
            undistorted=np.array(camera.undistorted),
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
        try:
            with np.load(path, allow_pickle=False) as file:
                content = {name: file[name] for name in ("format", *_ARRAYS)}
                undistorted = "undistorted" in file and bool(file["undistorted"])
            if int(content["format"]) != _FORMAT:
                raise RunError(f"{path} has format {content['format']}, this version reads {_FORMAT}: run again")
        except FileNotFoundError as error:
            raise RunError(f"{path} is missing: run the sequence again") from error
        except RunError:
            raise
        # Damaged bytes raise almost anything in zipfile, zlib, tokenize and NumPy: no list of types is complete.
        except Exception as error:
            reason = " ".join([f"{type(error).__name__}:", *str(error).split()])[:120]
            raise RunError(f"{path} is damaged ({reason}): run the sequence again") from error
        width, height, *pinhole = content["camera"].tolist()
        frames, ends = content["frames"].tolist(), np.cumsum(content["counts"])
        # the part after the last view is empty
        parts = [np.split(content[name], ends)[: len(frames)] for name in ("pixels", "descriptors", "points")]
        views = tuple(View(index, *arrays) for index, *arrays in zip(frames, *parts, strict=True))
        camera = Intrinsics(int(width), int(height), *pinhole, undistorted=undistorted)
        return cls(camera, views, content["T_world_camera"])
