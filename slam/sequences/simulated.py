"""The embedded sequence: a simulated street rendered in memory, with ground truth."""

from __future__ import annotations

import functools

import numpy as np

from slam.frames import Frame, Image, Intrinsics
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.poses import rebased
from slam.sequences.recording import Source, labels, require_frame, uniform_stamps
from slam.simulation.street import SimulatedStreet, SimulationOptions

FPS = 10.0
_CACHED_FRAMES = 32


class SimulatedSequence:
    """A ``SimulatedStreet`` as a sequence; ``street`` has the depth, the scans and the true surface.

    ``reference`` is re-based to the first camera; ``street.T_world_camera[0]`` takes it to the street.
    """

    def __init__(self, options: SimulationOptions, name: str = "sim") -> None:
        self.street = SimulatedStreet(options)
        self.name = name
        K = np.asarray(self.street.K, dtype=np.float64)
        self.intrinsics = Intrinsics(
            options.width, options.height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
        )
        self.stamps = uniform_stamps(options.frames, FPS)
        self.reference: FloatArray | None = rebased(np.asarray(self.street.T_world_camera, dtype=np.float64))
        self.camera_height_m: float | None = float(self.street.camera_height_m)
        self.T_camera_lidar: FloatArray | None = np.asarray(self.street.T_camera_lidar, dtype=np.float64)
        self.sources: tuple[Source, ...] = (Source(f"simulated/{options.seed}", first=None),)
        self._cached = functools.lru_cache(maxsize=_CACHED_FRAMES)(self._render)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.stamps)

    def frame(self, index: int) -> Frame:
        """Render one frame; recent ones are kept in memory."""
        require_frame(self.name, index, len(self))
        return Frame(index, float(self.stamps[index]), self._cached(index).copy())

    def has_scan(self, index: int) -> bool:
        """False: ``street.scan(index)`` gives scans, which are no part of the recording."""
        return False

    def scan(self, index: int) -> FloatArray:
        """Always ``SequenceError``: see `has_scan`."""
        raise SequenceError(f"frame {index} of {self.name} has no scan")

    def true_poses(self, start: int, stop: int) -> FloatArray | None:
        """``T_world_camera`` of the frames [start, stop), their first the world."""
        return None if self.reference is None else rebased(self.reference[start:stop])

    def true_depth_frames(self) -> range:
        """All frames."""
        return range(len(self))

    def true_depth(self, index: int) -> FloatArray:
        """True z-depth ``(H, W)`` of a frame in metres, 0 where unknown."""
        return np.asarray(self.street.depth(index), dtype=np.float64)

    def provenance(self) -> tuple[str, ...]:
        """The simulated world by its seed; all excerpts of it are of the same streets."""
        return labels(self.sources, len(self))

    def _render(self, index: int) -> Image:
        image: Image = self.street.render(index).image
        return image
