"""What was measured of a drive, collected frame by frame."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import islice
from typing import Any

import numpy as np

from erfsfm.common.readers.frame_range import runs
from slam.frames import (
    DepthMap,
    Ends,
    Frame,
    Image,
    Intrinsics,
    Mask,
    SnippetPoses,
    TrackingEvent,
    View,
    resized_depth,
)
from slam.frontend.followed_corners import CornerRecord, FollowedCorners
from slam.frontend.keyframes.local_map import LocalMap
from slam.frontend.road import RoadStep
from slam.frontend.visual.depth_error import DepthError
from slam.frontend.visual.motion import Motion, RelativeRotation
from slam.geometry.se3 import FloatArray
from slam.runtime.memory import Spilled, SpillFile

MAP_WIDTH_PX = 416  # of the depth that is fused: that of the networks
_MOST_NAMED = 10  # stretches of frames in a sentence
LAST_STEPS = 4  # in which the step to one of the last frames is looked up
# least steps that tell, and their share: of upright vehicles 0.86 to 1 have nearer corners below
_LEAST_VOTES, _UPSIDE_DOWN = 30, 1 / 3


class FrontEnd(Enum):
    """What measures the camera's motion."""

    STEPS = "steps from frame to frame"
    KEYFRAMES = "keyframes and their maps"


@dataclass(frozen=True)
class Keyframe:
    """A frame for fusion, thinned and spilled to disk."""

    index: int
    spilled_image: Spilled
    spilled_depth: Spilled

    @classmethod
    def of(cls, frame: Frame, depth_unscaled: DepthMap, spill_file: SpillFile) -> Keyframe:
        """Thin a frame and its depth, of any size, to at most ``MAP_WIDTH_PX`` and spill both."""
        height, width = frame.image.shape[:2]
        ratio = min(MAP_WIDTH_PX / width, 1.0)
        size = (max(round(width * ratio), 1), max(round(height * ratio), 1))
        image, depth = frame.resized(*size).image, resized_depth(depth_unscaled, *size)
        return cls(frame.index, spill_file.put(image), spill_file.put(depth))

    @property
    def image(self) -> Image:
        """``(h, w, 3)``."""
        return self.spilled_image()

    @property
    def depth_unscaled(self) -> DepthMap:
        """``(h, w)``."""
        return self.spilled_depth()

    def cloud_unscaled(self, intrinsics: Intrinsics, stride: int) -> FloatArray:
        """Points ``(M, 3)`` in its camera, of every ``stride``-th pixel; intrinsics of any size."""
        depth = self.depth_unscaled
        camera = intrinsics.resized(*depth.shape[::-1])
        v, u = np.mgrid[: camera.height : stride, : camera.width : stride].reshape(2, -1)
        points = camera.rays(np.column_stack([u, v])) * depth[v, u, None]
        return points[points[:, 2] > 0]


@dataclass
class Measured:
    """What was measured of a drive so far, in the networks' unit of length; all of it grows at its end alone.

    Attributes:
        snippets: by the pose network, by their sources.
        steps: that image geometry measured.
        road_steps: lengths of steps by the road's homography.
        relative_rotations: rotations across two steps, by their three frames.
        failures: steps that image geometry could not measure, with the share of corners that were
            found again.
        roads: of every frame, the camera's height over the ground plane, None where it was not seen.
        views: of frames among which loops are sought.
        keyframes: frames for the map.
        unusable: frames without a measurement, with the reason.
        repeated: frames with the image of the one before.
        moving: those of them just before which the camera moved.
        fixed: the part of the last image that is fixed to the camera.
        below_is_nearer: of each step, whether its corners below the axis are nearer than those above,
            as over any ground.

    Known once the front end has finished:
        depth_error: of learned depth, as the steps have it.
        corners: that the steps followed, from the principal point.
        maps: of keyframes; a drive measured by steps alone has none.
        events: what became of the maps.
    """

    snippets: dict[tuple[int, ...], SnippetPoses] = field(default_factory=dict)
    steps: dict[Ends, Motion] = field(default_factory=dict)
    road_steps: dict[Ends, RoadStep] = field(default_factory=dict)
    relative_rotations: dict[tuple[int, int, int], RelativeRotation] = field(default_factory=dict)
    failures: dict[Ends, float] = field(default_factory=dict)
    roads: list[float | None] = field(default_factory=list)
    views: list[View] = field(default_factory=list)
    keyframes: list[Keyframe] = field(default_factory=list)
    unusable: dict[int, str] = field(default_factory=dict)
    repeated: list[int] = field(default_factory=list)
    moving: list[int] = field(default_factory=list)
    fixed: Mask | None = None
    below_is_nearer: list[bool] = field(default_factory=list)
    depth_error: DepthError = field(default_factory=DepthError)
    corners: FollowedCorners = field(default_factory=CornerRecord().seen)
    maps: Sequence[LocalMap] = ()
    events: Sequence[TrackingEvent] = ()

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.roads)

    @property
    def front_end(self) -> FrontEnd:
        """What measured the camera's motion: keyframes, where they have a map."""
        return FrontEnd.KEYFRAMES if self.maps else FrontEnd.STEPS

    @property
    def is_upside_down(self) -> bool:
        """Whether the images show the world upside down, so that what looks like a road is the sky."""
        votes = self.below_is_nearer
        if self.maps or len(votes) < _LEAST_VOTES:  # a camera that is carried looks anywhere
            return False
        return sum(votes) < _UPSIDE_DOWN * len(votes)

    def last_step(self, index: int) -> Motion | None:
        """The step to one of the last frames, where image geometry measured it."""
        last = islice(reversed(self.steps.values()), LAST_STEPS)
        return next((motion for motion in last if motion.ends[1] == index), None)

    def copy(self) -> Measured:
        """A snapshot: what is measured later is added to one of both alone."""
        own: dict[str, Any] = {
            name: each.copy() for name, each in vars(self).items() if isinstance(each, list | dict)
        }
        return replace(self, **own)


def named(frames: Collection[int]) -> str:
    """Stretches of frames in words, the first ten of them."""
    found = runs(frames)
    words = [
        f"{first} to {last}" if last > first else str(first) for first, last in found[:_MOST_NAMED]
    ]
    return ", ".join(words) + ", ..." * (len(found) > _MOST_NAMED)
