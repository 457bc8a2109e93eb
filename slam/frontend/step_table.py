"""Every motion that image geometry measured, kept once under its two frames, unscaled.

A step leads from a frame to a later one: mostly to the next, but it may also lead over a gap or from a keyframe. The
links of a drive are the steps that follow each other from the first frame to the last; where no step was measured, a
link leads to the next frame.
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
        """A table of motions; a later one takes the place of an earlier one between the same frames."""
        return cls({motion.ends: motion for motion in motions})

    def __iter__(self) -> Iterator[Motion]:
        return iter(self.motions.values())

    def __len__(self) -> int:
        return len(self.motions)

    @property
    def relative_poses(self) -> list[RelativePose]:
        """What was measured, unscaled."""
        return [motion.relative_pose for motion in self]

    @property
    def triangulated(self) -> dict[Ends, Motion]:
        """The motions whose rotation and direction are by corners alone: their length may come from elsewhere."""
        return {ends: motion for ends, motion in self.motions.items() if motion.triangulated is not None}

    def replaced(self, motions: Mapping[Ends, Motion]) -> StepTable:
        """The same with other motions in the place of some."""
        return replace(self, motions={**self.motions, **motions})

    def without_frames(self, frames: Collection[int]) -> StepTable:
        """The steps that neither begin nor end at some frames."""
        kept = {ends: motion for ends, motion in self.motions.items() if not set(ends).intersection(frames)}
        return replace(self, motions=kept)


def shortest_by_start(steps: Iterable[Ends]) -> dict[int, Ends]:
    """Of the steps that begin at a frame the shortest one, by that frame."""
    shortest: dict[int, Ends] = {}
    for ends in sorted(steps):
        shortest.setdefault(ends[0], ends)
    return shortest


def path_between(by_start: Mapping[int, Ends], first: int, last: int) -> list[Ends] | None:
    """Steps from a frame to a later one, each beginning where the one before ends; None where one is missing."""
    path: list[Ends] = []
    while first < last:
        if first not in by_start:
            return None
        path.append(by_start[first])
        first = path[-1][1]
    return path if first == last else None


def links(steps: Iterable[Ends], frames: int) -> list[Ends]:
    """The steps that follow each other from frame 0 to the last one; single frames where no step begins."""
    by_start = shortest_by_start(steps)
    found: list[Ends] = []
    frame = 0
    while frame < frames - 1:
        found.append(by_start.get(frame, (frame, frame + 1)))
        frame = found[-1][1]
    return found
