"""What the measurements of a drive give: relative poses, loops and the trajectory that fits both."""

from __future__ import annotations

from dataclasses import dataclass

from slam.frontend.failure import MeasurementFailure
from slam.loops.closure import LoopClosures
from slam.pipeline.measurements import Measurements
from slam.pipeline.positioning import Location
from slam.pose_graph import PoseGraph
from slam.se3 import FloatArray


@dataclass(frozen=True)
class Solution:
    """The poses ``(N, 4, 4)`` of a drive, the loops kept and the graph; ``location`` as in `SlamResult`."""

    measured: Measurements
    loops: LoopClosures
    graph: PoseGraph
    T_world_camera: FloatArray
    location: Location | MeasurementFailure | None
