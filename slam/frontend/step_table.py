"""Steps, each from a frame to a later one: usually the next, but it may also cross a gap.

The links of a drive are consecutive steps from the first frame to the last; where no step was measured, a link is to
the next frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from slam.frames import Ends
from slam.frontend.visual.motion import Motion

# every motion that image geometry measured, kept once under its two frames, in the order in which they were measured
Steps = Mapping[Ends, Motion]


def triangulated(steps: Steps) -> dict[Ends, Motion]:
    """The steps whose length is free."""
    return {ends: motion for ends, motion in steps.items() if motion.is_triangulated}


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
