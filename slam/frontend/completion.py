"""A drive completed after its last frame: its gaps, rotations, road and segments.

Segments are where it is cut, because no measurement relates what follows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

from slam.frames import Ends, TrackingEvent, runs
from slam.frontend.drive import Drive, Segment
from slam.frontend.gaps import interpolate_gaps
from slam.frontend.keyframes.relative_poses import NO_MAPS, KeyframePoses
from slam.frontend.road import with_slope
from slam.frontend.rotations import smooth_rotations

# of the corners: across a cut few are found again, by chance, before a lorry half of them
_LEAST_FOUND = 0.2
_LONGEST_GAP = 30  # interpolated frames, after which the place is only guessed


def find_cuts(
    failures: Sequence[tuple[int, int, float]],
    measured: Collection[Ends],
    doubtful: Collection[int],
) -> list[int]:
    """Frames that show another place than the frame before: their step failed, the steps before and after did not.

    Args:
        failures: steps that image geometry could not measure, and the share of corners that were
            found again.
        measured: steps that it measured.
        doubtful: frames that are unusable or repeat the one before.
    """
    ends = set(measured)
    cuts = []
    for first, last, found in failures:
        around = {first - 1, first, last, last + 1}
        alone = last == first + 1 and {(first - 1, first), (last, last + 1)} <= ends
        if found < _LEAST_FOUND and alone and around.isdisjoint(doubtful):
            cuts.append(last)
    return cuts


def find_segments(
    count: int,
    cuts: Collection[int],
    interpolated: Mapping[int, str],
    is_related: Callable[[int], bool],
) -> list[Segment]:
    """The segments of a drive, by its cuts and its long gaps.

    Args:
        count: frames of the drive.
        cuts: frames that show another place than the frame before.
        interpolated: frames of gaps, with the reason.
        is_related: tells of a frame whether a map of keyframes relates the frames from it on to
            those before.
    """
    between = [cut for cut in cuts if not is_related(cut)]
    begins = {0: ""} | dict.fromkeys(between, "it shows another place than the frame before")
    ends = {count - 1} | {cut - 1 for cut in between}
    for first, last in runs(interpolated):
        if (
            last - first + 1 > _LONGEST_GAP
            and first > 0
            and last + 1 < count
            and not is_related(last + 1)
        ):
            ends.add(first - 1)
            begins[last + 1] = (
                f"{last - first + 1} frames before it are interpolated: {interpolated[first]}"
            )
    return [
        Segment(first, last, begins[first])
        for first, last in zip(sorted(begins), sorted(ends), strict=True)
    ]


def complete_drive(
    drive: Drive,
    sources: int,
    map_poses: KeyframePoses = NO_MAPS,
    joins: Sequence[TrackingEvent] = (),
) -> Drive:
    """The drive with its gaps interpolated, its rotations smoothed, its road by its path, and its segments.

    More frames may follow: the collected drive stays as it is.

    Args:
        drive: as it was collected.
        sources: frames of a snippet besides its target.
        map_poses: poses by the maps of keyframes of the drive.
        joins: events of loops that join these maps.

    Raises:
        SlamError: no snippet was measured, so there is no motion to extrapolate.
    """
    measured = {*drive.steps, *map_poses.steps}
    cuts = find_cuts(drive.failures, measured, {*drive.unusable, *drive.repeated})
    filled = interpolate_gaps(drive, sources, cuts, map_poses)
    smoothed = smooth_rotations(filled.steps, drive.relative_rotations)
    return replace(
        filled,
        motions=list(smoothed.values()),
        road_steps=with_slope(drive.road_steps, smoothed),
        segments=find_segments(len(drive), cuts, filled.interpolated, map_poses.relates),
        map_poses=map_poses,
        events=sorted([*drive.events, *joins], key=lambda event: event.frame),
    )
