"""The measurements of one pass over the frames of a sequence."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from slam.config import MappingConfig
from slam.depth_sampling import resized_depth
from slam.frames import DepthMap, Ends, Frame, Image, SnippetPoses
from slam.frontend.failure import MeasurementFailure
from slam.frontend.gap_interpolation import InterpolatedGaps
from slam.frontend.scale.road_homography import RoadStep
from slam.frontend.scale.road_plane import GroundPlane
from slam.frontend.segments import Segment, find_segments
from slam.frontend.step_table import StepTable
from slam.frontend.visual.motion import Motion
from slam.frontend.visual.relative_rotation import RelativeRotation
from slam.frontend.window.odometry import Segment as MapSegment
from slam.frontend.window.relative_poses import WindowPoses
from slam.loops.descriptors import View
from slam.pipeline.map_closure import MapClosure
from slam.storage.spill import SpilledArray, SpillFile

_EXAMPLES, _MOST_EXAMPLES = 5, 8


@dataclass(frozen=True)
class Keyframe:
    """A frame for fusion, thinned and spilled to disk."""

    index: int
    spilled_image: SpilledArray
    spilled_depth: SpilledArray

    @classmethod
    def of(cls, frame: Frame, depth_unscaled: DepthMap, spill_file: SpillFile, config: MappingConfig) -> Keyframe:
        """Thin a frame and its depth ``(H, W)`` to about ``width_px`` and spill both."""
        height, width = depth_unscaled.shape
        ratio = min(config.width_px / width, 1.0)
        image, depth = frame.image, depth_unscaled
        if ratio < 1.0:
            size = (max(round(width * ratio), 1), max(round(height * ratio), 1))
            depth = resized_depth(depth, *size)
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        return cls(frame.index, spill_file.put(image), spill_file.put(depth))

    @property
    def image(self) -> Image:
        """``(h, w, 3)``."""
        return self.spilled_image.read()

    @property
    def depth_unscaled(self) -> DepthMap:
        """``(h, w)``."""
        return self.spilled_depth.read()


@dataclass
class Observations:
    """Measurements in the networks' unit of length, collected frame by frame.

    ``motions`` are all steps that image geometry measured, ``road_steps`` the lengths by the road's homography,
    ``relative_rotations`` the rotations across several steps; ``failures`` are unmeasured steps with the reason.
    ``unusable`` are frames without a measurement, with the reason, ``repeated`` those with the image of the one before,
    ``moving`` those of them just before which the camera moved.
    """

    snippets: list[SnippetPoses] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)
    road_steps: dict[Ends, RoadStep] = field(default_factory=dict)
    relative_rotations: list[RelativeRotation] = field(default_factory=list)
    failures: list[tuple[int, int, str]] = field(default_factory=list)
    roads: list[GroundPlane | MeasurementFailure] = field(default_factory=list)
    views: list[View] = field(default_factory=list)
    keyframes: list[Keyframe] = field(default_factory=list)
    examples: list[tuple[int, Image, DepthMap]] = field(default_factory=list)
    unusable: dict[int, str] = field(default_factory=dict)
    repeated: list[int] = field(default_factory=list)
    moving: list[int] = field(default_factory=list)

    def repeat(self, index: int, moving: bool) -> None:
        """Add a frame with the image of the one before."""
        self.repeated.append(index)
        if moving:
            self.moving.append(index)


class Examples:
    """Chooses frames to keep whole for the report, evenly spread over a drive.

    Of a recording there are five, known before its first frame. Of a drive that grows, whose end nobody knows, every
    frame of a stride is kept, and the stride doubles where more than eight would be.
    """

    def __init__(self, recording: range | None = None) -> None:
        """Choose among the frames of a recording; None is a drive that grows."""
        self._stride = 1
        self._frames: frozenset[int] | None = None
        if recording is not None:
            spread = np.linspace(recording.start, recording.stop - 1, _EXAMPLES + 2).round().astype(int)
            self._frames = frozenset(spread[1:-1].tolist())

    def __contains__(self, index: int) -> bool:
        return index % self._stride == 0 if self._frames is None else index in self._frames

    def keep(self, frame: Frame, depth: DepthMap, kept: list[tuple[int, Image, DepthMap]]) -> None:
        """Add a chosen frame with its depth ``(H, W)`` to those that are kept."""
        kept.append((frame.index, frame.image, depth))
        if self._frames is None and len(kept) > _MOST_EXAMPLES:
            self._stride *= 2
            kept[:] = [example for example in kept if example[0] in self]


@dataclass(frozen=True)
class ClosedObservations:
    """The observations of a pass with its gaps interpolated; of interpolated frames only steps are kept.

    ``window`` are the poses by ``maps`` of keyframes; of a drive measured by steps alone there are none. ``closure`` is
    None before the maps are closed.
    """

    roads: list[GroundPlane | MeasurementFailure]
    road_steps: dict[Ends, RoadStep]
    relative_rotations: list[RelativeRotation]
    views: list[View]
    keyframes: list[Keyframe]
    examples: list[tuple[int, Image, DepthMap]]
    failures: list[tuple[int, int, str]]
    gaps: InterpolatedGaps
    segments: list[Segment]
    window: WindowPoses
    maps: tuple[MapSegment, ...]
    closure: MapClosure | None = None

    @classmethod
    def of(
        cls,
        seen: Observations,
        gaps: InterpolatedGaps,
        cuts: Collection[int] = (),
        window: WindowPoses | None = None,
        maps: tuple[MapSegment, ...] = (),
    ) -> ClosedObservations:
        """Leave out views and keyframes of interpolated frames."""
        return cls(
            seen.roads,
            seen.road_steps,
            seen.relative_rotations,
            [view for view in seen.views if view.index not in gaps.frames],
            [keyframe for keyframe in seen.keyframes if keyframe.index not in gaps.frames],
            seen.examples,
            seen.failures,
            gaps,
            find_segments(len(seen.roads), cuts, gaps.frames),
            window or WindowPoses(),
            maps,
        )

    def with_closure(self, closure: MapClosure) -> ClosedObservations:
        """The same with poses by closed maps, which also relate segments of the drive that lie in one map."""
        found: list[Segment] = []
        for segment in self.segments:
            if found and closure.poses.relates(segment.first):
                found[-1] = replace(found[-1], last=segment.last)
            else:
                found.append(segment)
        return replace(self, window=closure.poses, segments=found, closure=closure)

    @property
    def snippets(self) -> list[SnippetPoses]:
        """One a target, in time order."""
        return self.gaps.snippets

    @property
    def steps(self) -> StepTable:
        """Steps of image geometry."""
        return self.gaps.steps

    @property
    def interpolated(self) -> dict[int, str]:
        """Interpolated frames, and why."""
        return self.gaps.frames
