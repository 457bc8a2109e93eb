"""What the pass over the frames gives."""

from __future__ import annotations

from dataclasses import dataclass

from slam.frames import TrackingEvent
from slam.frontend.drive import Drive
from slam.frontend.image_gate import GateState
from slam.frontend.keyframes.local_map import MapSegment
from slam.frontend.visual.odometry import OdometryState


@dataclass(frozen=True)
class Observations:
    """All measurements up to a frame, which stay while others follow.

    ``maps`` are those of keyframes, none of a drive that is measured by steps alone, and ``events`` what became of
    them.
    """

    drive: Drive
    gate: GateState
    odometry: OdometryState
    maps: tuple[MapSegment, ...]
    events: list[TrackingEvent]
