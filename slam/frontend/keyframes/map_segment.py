"""One map of keyframes with the frames that were located in it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from slam.frames import RelativePose
from slam.frontend.keyframes.local_map import LocalMap, TrackIds
from slam.frontend.tracking import Pixels
from slam.geometry.se3 import FloatArray


@dataclass(frozen=True)
class TrackedFrame:
    """Corners of a frame, ``track_ids`` ``(M,)`` and ``pixels`` ``(M, 2)``; its pose, None where it was lost."""

    index: int
    track_ids: TrackIds
    pixels: Pixels
    T_camera_world: FloatArray | None


@dataclass
class MapSegment:
    """One map, from its first keyframe to a loss: ``frames`` in time order; ``started`` once it has points.

    ``turns`` are motions of the camera where no point carries the unit, in the unit of learned depth.
    """

    map: LocalMap = field(default_factory=LocalMap)
    frames: list[TrackedFrame] = field(default_factory=list)
    started: bool = False
    turns: list[RelativePose] = field(default_factory=list)

    def copy(self) -> MapSegment:
        """A snapshot, which stays while this map grows."""
        return replace(self, map=self.map.copy(), frames=self.frames.copy(), turns=self.turns.copy())
