"""The observations of the last frames of a drive, as those of a drive that begins there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import takewhile
from typing import TypeVar

from slam.frontend.gap_interpolation import interpolate_gaps
from slam.frontend.step_table import StepTable
from slam.frontend.visual.motion import Motion
from slam.pipeline.observations import ClosedObservations, Observations

T = TypeVar("T")


def recent(seen: Observations, first: int) -> Observations:
    """What was measured from frame ``first`` on, which becomes frame 0; without views and keyframes.

    It takes as long as there are frames since, however long the drive.
    """

    def since(items: Iterable[T], start: Callable[[T], int]) -> list[T]:
        """Those that begin in the window, of items in order of time; they may span a few frames."""
        newest = takewhile(lambda item: start(item) >= first, _backwards(items))
        return list(newest)[::-1]

    return Observations(
        snippets=[
            replace(s, target=s.target - first, sources=tuple(source - first for source in s.sources))
            for s in since(seen.snippets, lambda s: min(s.sources))
        ],
        motions=[_moved(motion, first) for motion in since(seen.motions, lambda m: m.ends[0])],
        road_steps={
            (ends[0] - first, ends[1] - first): step
            for ends, step in since(seen.road_steps.items(), lambda item: item[0][0])
        },
        relative_rotations=[
            replace(rotation, from_index=rotation.from_index - first, to_index=rotation.to_index - first)
            for rotation in since(seen.relative_rotations, lambda r: min(r.from_index, r.to_index))
        ],
        failures=[(a - first, b - first, why) for a, b, why in since(seen.failures, lambda failure: failure[0])],
        roads=seen.roads[first:],
        unusable={index - first: why for index, why in since(seen.unusable.items(), lambda item: item[0])},
        repeated=[index - first for index in since(seen.repeated, lambda index: index)],
    )


def closed(seen: Observations, sources: int) -> ClosedObservations:
    """Observations with their gaps interpolated; ``sources`` are those of a snippet."""
    steps = StepTable.of(seen.motions)
    gaps = interpolate_gaps(len(seen.roads), sources, seen.snippets, steps, seen.unusable, seen.repeated)
    return ClosedObservations.of(seen, gaps)


def _backwards(items: Iterable[T]) -> Iterator[T]:
    return reversed(items)  # type: ignore[call-overload,no-any-return]


def _moved(motion: Motion, first: int) -> Motion:
    step = motion.relative_pose
    return replace(
        motion, relative_pose=replace(step, from_index=step.from_index - first, to_index=step.to_index - first)
    )
