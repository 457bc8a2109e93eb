"""The embedded sequence: a simulated world rendered in memory, with ground truth."""

from __future__ import annotations

import functools

import numpy as np

from slam.frames import Image, Intrinsics
from slam.geometry.se3 import FloatArray
from slam.sequences.recording import RecordedSequence, Source, uniform_stamps
from slam.simulation.kitti_layout import simulated_world
from slam.simulation.options import SimulationOptions
from slam.simulation.world import SimulatedWorld

_CACHED_FRAMES = 32


class SimulatedSequence(RecordedSequence):
    """A ``SimulatedWorld`` as a sequence; ``street`` has the depth, the scans and the true surface.

    ``reference`` is re-based to the first camera; ``street.T_world_camera[0]`` takes it to the street.
    """

    def __init__(self, options: SimulationOptions, name: str = "sim") -> None:
        self.street = simulated_world(options)
        K = np.asarray(self.street.K, dtype=np.float64)
        focal_and_centre = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        super().__init__(
            name,
            _Renderings(self.street),
            Intrinsics(options.width, options.height, *focal_and_centre, readout_s=options.readout_s),
            uniform_stamps(options.frames, options.rate),
            (Source(f"simulated/{options.seed}", first=None),),
            T_any_camera=np.asarray(self.street.T_world_camera, dtype=np.float64),
            usual_height_m=self.street.camera_height_m,
            T_camera_lidar=self.street.T_camera_lidar,
            distance_to_surface=self.street.distance_to_surface,
        )

    def true_depth_frames(self) -> list[int]:
        """All frames."""
        return list(range(len(self)))

    def true_depth(self, index: int) -> FloatArray:
        """True z-depth ``(H, W)`` of a frame in metres, 0 where unknown."""
        return np.asarray(self.street.depth(self.start + index), dtype=np.float64)


class _Renderings:
    """The images of a street; recent ones are kept in memory."""

    def __init__(self, street: SimulatedWorld) -> None:
        self.width, self.height = street.options.width, street.options.height
        self._frames = street.options.frames
        self._cached = functools.lru_cache(maxsize=_CACHED_FRAMES)(lambda index: street.render(index).image)

    def __len__(self) -> int:
        return self._frames

    def read(self, index: int) -> Image:
        """Render one image ``(height, width, 3)`` uint8 RGB."""
        image: Image = self._cached(index).copy()
        return image
