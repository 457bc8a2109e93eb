"""Warnings of what a pass over the frames cannot decide."""

from __future__ import annotations

import logging

from slam.frames import runs
from slam.frontend.drive import DOUBLED, Drive
from slam.frontend.image_gate import GateState
from slam.frontend.segments import named

logger = logging.getLogger(__name__)

# real drives with automatic exposure have 0.13 at ten frames a second and 0.51 at two
_ROLLING_EXPOSURE = 0.6
_LEAST_COMPARED = 30
_LEAST_STANDING = 0.02  # of the image


def warn_of_doubts(drive: Drive, gate: GateState) -> None:
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
