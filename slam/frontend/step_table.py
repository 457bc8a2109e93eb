"""Every motion that image geometry measured, kept once under its two frames, unscaled.

A step is from a frame to a later one: usually the next, but it may also cross a gap. The links of a drive are
consecutive steps from the first frame to the last; where no step was measured, a link is to the next frame.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

from slam.frames import Ends, RelativePose
from slam.frontend.visual.motion import Motion

T = TypeVar("T")


@dataclass(frozen=True)
class StepTable:
    """Motions by their two frames, in the order in which they were measured."""

    motions: Mapping[Ends, Motion]

    @classmethod
    def of(cls, motions: Iterable[Motion]) -> StepTable:
        """A table of motions; a later one replaces an earlier one between the same frames."""
        return cls({motion.ends: motion for motion in motions})

    def __iter__(self) -> Iterator[Motion]:
        return iter(self.motions.values())

    def __len__(self) -> int:
        return len(self.motions)

    @property
    def relative_poses(self) -> list[RelativePose]:
        """All relative poses, unscaled."""
        return [motion.relative_pose for motion in self]

    @property
    def triangulated(self) -> dict[Ends, Motion]:
        """The motions whose length is free."""
        return {ends: motion for ends, motion in self.motions.items() if motion.is_triangulated}

    def replaced(self, motions: Mapping[Ends, Motion]) -> StepTable:
        """The same with some motions replaced."""
        return replace(self, motions={**self.motions, **motions})

    def without_frames(self, frames: Collection[int]) -> StepTable:
        """The steps that neither begin nor end at these frames."""
        kept = {ends: motion for ends, motion in self.motions.items() if not set(ends).intersection(frames)}
        return replace(self, motions=kept)


def shortest_by_start(steps: Iterable[Ends]) -> dict[int, Ends]:
    """The shortest step from each frame, by that frame."""
    shortest: dict[int, Ends] = {}
    for ends in sorted(steps):
        shortest.setdefault(ends[0], ends)
    return shortest


def path_between(by_start: Mapping[int, Ends], first: int, last: int) -> list[Ends] | None:
    """Consecutive steps from a frame to a later one; None where one is missing."""
    path: list[Ends] = []
    while first < last:
        if first not in by_start:
            return None
        path.append(by_start[first])
        first = path[-1][1]
    return path if first == last else None


def links(steps: Iterable[Ends], frames: int) -> list[Ends]:
    """Consecutive steps from frame 0 to the last one; from a frame without a step, to the next frame."""
    by_start = shortest_by_start(steps)
    found: list[Ends] = []
    frame = 0
    while frame < frames - 1:
        found.append(by_start.get(frame, (frame, frame + 1)))
        frame = found[-1][1]
    return found
