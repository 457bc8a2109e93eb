"""A drive completed after its last frame: its gaps, rotations, road and segments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from slam.frames import TrackingEvent
from slam.frontend.drive import Drive
from slam.frontend.gaps import interpolate_gaps
from slam.frontend.keyframes.relative_poses import NO_MAPS, KeyframePoses
from slam.frontend.road import with_slope
from slam.frontend.rotations import smooth_rotations
from slam.frontend.segments import find_cuts, find_segments


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
