"""A drive as it is known after its last frame: gaps filled, rotations smoothed, its road and its segments."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from erfsfm.common.readers.frame_range import runs
from slam.frames import Ends, RelativePose, SnippetPoses, TrackingEvent, View
from slam.frontend.keyframes.relative_poses import NO_MAPS, KeyframePoses
from slam.frontend.measured import FrontEnd, Keyframe, Measured, named
from slam.frontend.road import RoadStep
from slam.frontend.visual.motion import Motion, Steps, triangulated
from slam.geometry.se3 import FloatArray, path_distance

logger = logging.getLogger(__name__)

DOUBLED = "the image repeats the one before while the camera moves"
_LONGEST_GAP = 30  # interpolated frames, after which the place is only guessed
# a step so many times as long as nine of ten is none of a camera: about 100 medians
_LEAP, _USUAL = 50.0, 0.9


@dataclass(frozen=True)
class Segment:
    """Frames ``first`` to ``last`` that no measurement relates to those before; ``reason`` says why it begins."""

    first: int
    last: int
    reason: str


@dataclass(frozen=True)
class Drive:
    """A drive whose every frame is related to the one before, in the networks' unit of length.

    Attributes:
        measured: what it was completed from.
        steps: those of image geometry, their rotations smoothed; none between interpolated frames.
        road_steps: lengths by the road, with the camera's pitch by the path.
        snippets: of the pose network, one a target; missing ones are interpolated.
        network_steps: ``T_k_next`` by k, unscaled, of the snippets that it measured on usable frames.
        interpolated: the frames of gaps, with the reason.
        gap_steps: the steps of gaps.
        cuts: frames that show another place than the frame before.
        segments: parts of the drive that no measurement relates; known once it is `parted`.
        map_poses: poses by the maps of keyframes.
        events: what became of these maps.
    """

    measured: Measured
    steps: Steps = field(default_factory=dict)
    road_steps: Mapping[Ends, RoadStep] = field(default_factory=dict)
    snippets: Sequence[SnippetPoses] = ()
    network_steps: Mapping[int, FloatArray] = field(default_factory=dict)
    interpolated: Mapping[int, str] = field(default_factory=dict)
    gap_steps: Sequence[RelativePose] = ()
    cuts: Sequence[int] = ()
    segments: Sequence[Segment] = ()
    map_poses: KeyframePoses = NO_MAPS
    events: Sequence[TrackingEvent] = ()

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.measured)

    @property
    def by_keyframes(self) -> bool:
        """Whether maps of keyframes give the poses, and not steps."""
        return self.measured.front_end is FrontEnd.KEYFRAMES

    @cached_property
    def triangulated(self) -> Mapping[Ends, Motion]:
        """The steps whose length is free."""
        return triangulated(self.steps)

    @cached_property
    def views(self) -> list[View]:
        """Those of frames that are not interpolated."""
        return [view for view in self.measured.views if view.index not in self.interpolated]

    @cached_property
    def keyframes(self) -> list[Keyframe]:
        """Those for the map, of frames that are not interpolated."""
        return [each for each in self.measured.keyframes if each.index not in self.interpolated]

    @property
    def doubled(self) -> list[int]:
        """Frames that repeat the one before while the camera moves, not interpolated, at most two in a row.

        More in a row are a camera that stands. At the end of a drive nobody knows.
        """
        moving = set(self.measured.moving).difference(self.interpolated)
        found: list[int] = []
        for first, last in runs(self.measured.repeated):
            if last - first < 2 and last < len(self) - 1:
                found += sorted(moving.intersection(range(first, last + 1)))
        return found

    @property
    def support(self) -> FloatArray | None:
        """The share of the corners that fit the motion to each frame ``(N,)``, 0 without one; the first has the next's.

        None where maps of keyframes give the poses.
        """
        if self.by_keyframes:
            return None
        support = np.zeros(len(self))
        for (_, last), motion in self.steps.items():
            support[last] = max(support[last], motion.support)
        support[0] = support[1]
        return support

    def parted(self, T_world_camera: FloatArray) -> Drive:
        """The drive with its segments, by its cuts and its long gaps that no map of keyframes relates.

        One also begins after each step of its trajectory ``(N, 4, 4)`` that no camera makes: maps that contradict each
        other leave such steps.
        """
        begins: dict[int, str] = {}
        if self.by_keyframes:
            lengths = np.diff(path_distance(T_world_camera))
            leaps = np.flatnonzero(lengths > _LEAP * np.quantile(lengths, _USUAL)) + 1
            seen = [k for k in leaps.tolist() if {k - 1, k}.isdisjoint(self.interpolated)]
            begins |= dict.fromkeys(seen, "no camera makes the step to it")
        across = self.map_poses.across
        between = [cut for cut in self.cuts if across(cut) is None]
        begins |= dict.fromkeys(between, "it shows another place than the frame before")
        ends = {len(self) - 1}.union(k - 1 for k in begins)
        for first, last in runs(self.interpolated):
            frames, after = last - first + 1, last + 1
            is_inside = first > 0 and after < len(self)
            if frames > _LONGEST_GAP and is_inside and across(after) is None:
                ends.add(first - 1)
                begins[after] = (
                    f"{frames} frames before it are interpolated: {self.interpolated[first]}"
                )
        begins[0] = ""
        pairs = zip(sorted(begins), sorted(ends), strict=True)
        return replace(self, segments=[Segment(*each, begins[each[0]]) for each in pairs])


def warn_of_doubts(drive: Drive) -> None:
    """Warn of gaps, of segments, whose places are guesses, and of a frozen end: did the camera stand there?"""
    gaps, later, doubled = drive.interpolated, drive.segments[1:], drive.doubled
    if gaps:
        more = ", ..." if len(set(gaps.values())) > 1 else ""
        logger.warning("frames %s are interpolated: %s%s", named(gaps), gaps[min(gaps)], more)
    if later:
        begins = named([segment.first for segment in later])
        logger.warning(
            "a new segment of the drive begins at frame %s (%s): its place relative to the frames before is a guess",
            begins,
            later[0].reason,
        )
    if doubled:
        logger.warning("of %d frames %s: %s", len(doubled), DOUBLED, named(doubled))
    end = len(drive) - 1
    for first, last in runs(drive.measured.repeated):
        if last == end and end not in drive.interpolated:
            logger.warning(
                "frames %d to %d, the last ones, repeat frame %d: the camera is taken to stand; if the video "
                "froze, leave them out with --frames",
                first,
                last,
                first - 1,
            )
