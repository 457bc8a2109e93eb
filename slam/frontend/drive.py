"""The measurements of one drive: collected frame by frame, then completed after the last frame."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, replace
from itertools import takewhile
from typing import Any, TypeVar

import numpy as np

from slam.frames import (
    DepthMap,
    Ends,
    Frame,
    Image,
    Intrinsics,
    Mask,
    RelativePose,
    SnippetPoses,
    TrackingEvent,
    View,
    resized_depth,
    runs,
)
from slam.frontend.keyframes.local_map import LocalMap
from slam.frontend.keyframes.relative_poses import KeyframePoses
from slam.frontend.road import RoadStep
from slam.frontend.visual.motion import Motion, RelativeRotation, Steps
from slam.frontend.visual.self_calibration import DepthError, FocalLength
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import Failed
from slam.runtime.memory import SpilledArray, SpillFile

T = TypeVar("T")

MAP_WIDTH_PX = 416  # of the depth that is fused: that of the networks
_MOST_NAMED = 10  # stretches of frames in a sentence
LAST_STEPS = 4  # in which the step to one of the last frames is looked up
DOUBLED = "the image repeats the one before while the camera moves"


@dataclass(frozen=True)
class Keyframe:
    """A frame for fusion, thinned and spilled to disk."""

    index: int
    spilled_image: SpilledArray
    spilled_depth: SpilledArray

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
        return self.spilled_image.read()

    @property
    def depth_unscaled(self) -> DepthMap:
        """``(h, w)``."""
        return self.spilled_depth.read()

    def cloud_unscaled(self, intrinsics: Intrinsics, stride: int) -> FloatArray:
        """Points ``(M, 3)`` in its camera, of every ``stride``-th pixel; intrinsics of any size."""
        depth = self.depth_unscaled
        camera = intrinsics.resized(*depth.shape[::-1])
        v, u = np.mgrid[: camera.height : stride, : camera.width : stride].reshape(2, -1)
        points = camera.rays(np.column_stack([u, v])) * depth[v, u, None]
        return np.asarray(points[points[:, 2] > 0])


@dataclass(frozen=True)
class Segment:
    """Frames ``first`` to ``last`` that no measurement relates to those before; ``reason`` says why it begins."""

    first: int
    last: int
    reason: str


@dataclass
class Drive:
    """Measurements of a drive in the networks' unit of length.

    Collected frame by frame, each list and dictionary growing at its end:
        ``motions`` are all steps that image geometry measured, ``road_steps`` the lengths by the
        road's homography, ``relative_rotations`` the rotations across several steps; ``failures``
        are unmeasured steps with the share of corners that were found again. ``roads`` has one
        entry a frame, the camera's height over the ground plane. ``unusable`` are frames without a
        measurement, with the reason, ``repeated`` frames with the image of the one before,
        ``moving`` those of them just before which the camera moved.
        ``depth_error`` is that of learned depth and ``focal_length`` the one that corners show, as
        the steps have them. ``maps`` are those of keyframes and
        ``events`` what became of them; a drive measured by steps alone has none. ``fixed`` is the
        part of the last image that is fixed to the camera.

    Added by `slam.frontend.completion.complete_drive`, which also leaves out views and keyframes of
    interpolated frames, fills ``snippets`` to one a target, and smooths the rotations of
    ``motions``:
        ``trusted`` are the snippets that the network measured on usable frames, ``interpolated``
        the frames of gaps with the reason, ``gap_steps`` their steps, ``map_poses`` the poses by
        the maps.
    """

    snippets: list[SnippetPoses] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)
    road_steps: dict[Ends, RoadStep] = field(default_factory=dict)
    relative_rotations: list[RelativeRotation] = field(default_factory=list)
    failures: list[tuple[int, int, float]] = field(default_factory=list)
    roads: list[float | Failed] = field(default_factory=list)
    views: list[View] = field(default_factory=list)
    keyframes: list[Keyframe] = field(default_factory=list)
    unusable: dict[int, str] = field(default_factory=dict)
    repeated: list[int] = field(default_factory=list)
    moving: list[int] = field(default_factory=list)
    depth_error: DepthError = field(default_factory=DepthError)
    focal_length: FocalLength = field(default_factory=FocalLength)
    fixed: Mask | None = None

    trusted: list[SnippetPoses] = field(default_factory=list)
    interpolated: dict[int, str] = field(default_factory=dict)
    gap_steps: list[RelativePose] = field(default_factory=list)
    segments: list[Segment] = field(default_factory=list)
    maps: list[LocalMap] = field(default_factory=list)
    map_poses: KeyframePoses = field(default_factory=KeyframePoses)
    events: list[TrackingEvent] = field(default_factory=list)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.roads)

    @property
    def steps(self) -> Steps:
        """The steps of image geometry; a later one replaces an earlier one between the same frames."""
        return {motion.ends: motion for motion in self.motions}

    @property
    def doubled(self) -> list[int]:
        """Frames that repeat the one before while the camera moves, not interpolated, at most two in a row.

        More in a row are a camera that stands. At the end of a drive nobody knows.
        """
        moving = set(self.moving).difference(self.interpolated)
        found: list[int] = []
        for first, last in runs(self.repeated):
            if last - first < 2 and last < len(self) - 1:
                found += sorted(moving.intersection(range(first, last + 1)))
        return found

    @property
    def support(self) -> FloatArray | None:
        """`frame_support` of all frames ``(N,)``; None where maps of keyframes give the poses."""
        return None if self.maps else frame_support(range(len(self)), self.motions)

    def last_step(self, index: int) -> Motion | None:
        """The step to one of the last frames, where image geometry measured it."""
        return next(
            (motion for motion in self.motions[-LAST_STEPS:] if motion.ends[1] == index), None
        )

    def copy(self) -> Drive:
        """A snapshot: what is measured later is added to one of both alone."""
        own: dict[str, Any] = {
            name: each.copy() for name, each in vars(self).items() if isinstance(each, list | dict)
        }
        return replace(self, **own)

    def since(self, first: int) -> Drive:
        """The measurements from frame ``first`` on, which becomes frame 0; without views and keyframes.

        It takes as long as there are frames since, however long the drive.
        """

        def last(items: Iterable[T], start: Callable[[T], int]) -> list[T]:
            """The items that begin in the window, of items in order of time that may span a few frames."""
            return list(takewhile(lambda item: start(item) >= first, items))[::-1]

        def renumbered(ends: Ends) -> Ends:
            return ends[0] - first, ends[1] - first

        window = Drive(roads=self.roads[first:])
        for snippet in last(reversed(self.snippets), lambda snippet: min(snippet.sources)):
            target = snippet.target - first
            sources = tuple(source - first for source in snippet.sources)
            window.snippets.append(replace(snippet, target=target, sources=sources))
        for motion in last(reversed(self.motions), lambda motion: motion.ends[0]):
            from_index, to_index = renumbered(motion.ends)
            pose = replace(motion.relative_pose, from_index=from_index, to_index=to_index)
            window.motions.append(replace(motion, relative_pose=pose))
        for ends, step in last(reversed(self.road_steps.items()), lambda item: item[0][0]):
            window.road_steps[renumbered(ends)] = step
        for turn in last(reversed(self.relative_rotations), lambda turn: turn.ends[0]):
            window.relative_rotations.append(replace(turn, ends=renumbered(turn.ends)))
        for earlier, later, found in last(reversed(self.failures), lambda failure: failure[0]):
            window.failures.append((*renumbered((earlier, later)), found))
        for frame, why in last(reversed(self.unusable.items()), lambda item: item[0]):
            window.unusable[frame - first] = why
        for frame in last(reversed(self.repeated), lambda frame: frame):
            window.repeated.append(frame - first)
        return window


def frame_support(frames: range, motions: Iterable[Motion]) -> FloatArray:
    """The share of the corners that fit the motion to each frame ``(N,)``, 0 without one; the first has the next's."""
    found: dict[int, float] = {}
    for motion in motions:
        found[motion.ends[1]] = max(found.get(motion.ends[1], 0.0), motion.support)
    found[0] = found.get(1, 0.0)
    return np.array([found.get(frame, 0.0) for frame in frames])


def named(frames: Collection[int]) -> str:
    """Stretches of frames in words, the first ten of them."""
    found = runs(frames)
    words = [
        f"{first} to {last}" if last > first else str(first) for first, last in found[:_MOST_NAMED]
    ]
    return ", ".join(words) + ", ..." * (len(found) > _MOST_NAMED)
