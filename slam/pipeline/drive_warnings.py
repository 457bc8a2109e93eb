"""Warnings of what a pass over the frames cannot decide."""

from __future__ import annotations

import logging

from slam.frames import runs
from slam.frontend.drive import DOUBLED, Drive
from slam.frontend.image_gate import GateState

logger = logging.getLogger(__name__)

_MOST_NAMED = 10
# real drives with automatic exposure have 0.13 at ten frames a second and 0.51 at two
_ROLLING_EXPOSURE = 0.6
_LEAST_COMPARED = 30
_LEAST_STANDING = 0.02  # of the image


def warn_of_doubts(drive: Drive, gate: GateState) -> None:
    """Warn of gaps, of segments, whose places are guesses, and of a frozen end: did the camera stand there?"""
    gaps = runs(drive.interpolated)
    for first, last in gaps[:_MOST_NAMED]:
        logger.warning("frames %d to %d are interpolated: %s", first, last, drive.interpolated[first])
    if len(gaps) > _MOST_NAMED:
        more, frames_of_them = gaps[_MOST_NAMED:], sum(last - first + 1 for first, last in gaps[_MOST_NAMED:])
        logger.warning("%d more stretches are interpolated, of %d frames: see metrics.json", len(more), frames_of_them)
    _warn_of_segments(drive)
    doubled = drive.doubled
    if doubled:
        named = ", ".join(map(str, doubled[:_MOST_NAMED])) + (", ..." if len(doubled) > _MOST_NAMED else "")
        logger.warning("of %d frames %s: %s", len(doubled), DOUBLED, named)
    if gate.compared >= _LEAST_COMPARED and gate.exposed > _ROLLING_EXPOSURE * gate.compared:
        logger.warning(
            "the exposure rolls: %d of %d images are more than a tenth brighter or darker than the one before; fix the "
            "exposure, or its flicker under lamps",
            gate.exposed,
            gate.compared,
        )
    if gate.standing is not None and gate.standing.mean() > _LEAST_STANDING:
        logger.warning(
            "%.0f %% of the image stand still while the camera moves (bars, a logo, the bonnet): no corner, depth or "
            "road is taken from there",
            100 * gate.standing.mean(),
        )
    end = len(drive) - 1
    for first, last in runs(drive.repeated):
        if last == end and end not in drive.interpolated:
            logger.warning(
                "frames %d to %d, the last ones, repeat frame %d: the camera is taken to stand; if the video "
                "froze, leave them out with --frames",
                first,
                last,
                first - 1,
            )


def _warn_of_segments(drive: Drive) -> None:
    """Where a segment begins, its place relative to the ones before is a guess."""
    later = drive.segments[1:]
    for segment in later[:_MOST_NAMED]:
        logger.warning(
            "a new segment of the drive begins at frame %d (%s): its place relative to the frames before is a guess",
            segment.first,
            segment.reason,
        )
    if len(later) > _MOST_NAMED:
        logger.warning("%d more segments begin: see metrics.json", len(later) - _MOST_NAMED)


def warn_of_another_place(drive: Drive, first: int) -> None:
    """Copies of other recordings under the same name, and folders, are known by their first image alone."""
    for start, end, reason in drive.failures:
        if (start, end) == (first - 1, first) and first not in drive.interpolated:
            logger.warning(
                "frame %d, the first that follows, does not match frame %d (%s): make sure that it was taken "
                "right after it on the same drive",
                end,
                start,
                reason,
            )
