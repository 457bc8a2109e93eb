"""The embedded sequence: a simulated world rendered in memory, with ground truth."""

from __future__ import annotations

import functools

import numpy as np

from slam.frames import Image
from slam.sequences.images import ReadImages
from slam.sequences.recording import RecordedSequence, Source, uniform_stamps
from slam.simulation.kitti_layout import simulated_world
from slam.simulation.options import SimulationOptions

_CACHED_FRAMES = 32


class SimulatedSequence(RecordedSequence):
    """A ``SimulatedWorld`` as a sequence; ``street`` has the depth, the scans and the true surface.

    ``reference`` is re-based to the first camera; ``street.T_world_camera[0]`` takes it to the street.
    """

    def __init__(self, options: SimulationOptions, name: str = "sim") -> None:
        street = self.street = simulated_world(options)
        rendered = functools.lru_cache(maxsize=_CACHED_FRAMES)(lambda index: street.render(index).image)

        def read(index: int) -> Image:
            image: Image = rendered(index).copy()
            return image

        super().__init__(
            name,
            ReadImages(options.width, options.height, options.frames, read),
            street.camera,
            uniform_stamps(options.frames, options.rate),
            (Source(f"simulated/{options.seed}", first=None),),
            T_any_camera=np.asarray(street.T_world_camera, dtype=np.float64),
            usual_height_m=street.camera_height_m,
            T_camera_lidar=street.T_camera_lidar,
            depth_maps={k: functools.partial(street.depth, k) for k in range(options.frames)},
            distance_to_surface=street.distance_to_surface,
        )
