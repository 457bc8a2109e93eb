"""What the networks are asked for a frame, and what of it is pending."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.frames import DepthMap, Frame, Mask, Predictor, Sequence, SnippetPoses, resized_mask
from slam.frontend.drive import Drive
from slam.frontend.failure import MeasurementFailure
from slam.frontend.scale.road_plane import GroundPlane
from slam.frontend.visual.motion import Motion
from slam.runtime.errors import SequenceError, SlamError

_MOVED_ON_HEIGHTS = 1.5  # way of the camera after which depth is predicted again, camera heights
_LAST_STEPS = 4
_LAST_ROADS = 8  # looked back for the camera's height, frames


@dataclass(frozen=True)
class PendingFrame:
    """A frame submitted to the networks, whose other measurements are pending; None is not asked for.

    The pixels ``standing`` ``(h, w)`` of its image, in any size, do not belong to the world.
    """

    frame: Frame
    depth: Future[DepthMap] | None
    snippet: Future[SnippetPoses] | None
    standing: Mask | None

    def visible(self, depth: DepthMap) -> DepthMap:
        """Depth ``(H, W)``, unknown where pixels stand."""
        if self.standing is None:
            return depth
        return np.where(resized_mask(self.standing, *depth.shape[::-1]), np.float32(0), depth)


@dataclass(frozen=True)
class RecentFrame:
    """A frame to measure steps from, its depth ``(H, W)``, None until that is needed, and camera height, unscaled."""

    frame: Frame
    depth: DepthMap | None
    height: float | None


@dataclass(frozen=True)
class PendingTask:
    """A task of another thread, the stage that waits for it, and what to do with its ``result``."""

    stage: str
    result: Future[Any]
    keep: Callable[[Any], None]


def last_step(drive: Drive, index: int) -> Motion | None:
    """The step to one of the last frames, where image geometry measured it."""
    return next((motion for motion in drive.motions[-_LAST_STEPS:] if motion.ends[1] == index), None)


def has_moved_on(drive: Drive, step: Motion, frames: int) -> bool:
    """Whether so many more steps as this one leave what the last predicted depth shows."""
    roads = drive.roads[: step.ends[1] + 1][-_LAST_ROADS:]
    height = next((height for road in reversed(roads) if (height := height_of(road)) is not None), math.inf)
    return frames * step.length_unscaled > _MOVED_ON_HEIGHTS * height


def height_of(road: GroundPlane | MeasurementFailure) -> float | None:
    """The camera's height over the ground plane of a frame, unscaled; None without one."""
    return road.height_unscaled if isinstance(road, GroundPlane) else None


def predicted_depth(predictor: Predictor, frame: Frame) -> DepthMap:
    """Depth ``(H, W)`` of a frame.

    Raises:
        SlamError: a user's predictor gives something else.
    """
    depth = predictor.depth(frame)
    wanted, shape, kind = frame.image.shape[:2], np.shape(depth), getattr(depth, "dtype", type(depth).__name__)
    if shape != wanted or kind != np.float32:
        raise SlamError(f"the predictor's depth of frame {frame.index} must be {wanted} float32; got {shape} {kind}")
    return depth


def read_frame(sequence: Sequence, index: int) -> Frame | SequenceError:
    """A frame, or why its image cannot be read."""
    try:
        frame = sequence.frame(index)
        frame.image.setflags(write=False)
        return frame
    except SequenceError as error:
        return error
