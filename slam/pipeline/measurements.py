"""What the front end measured on a whole drive."""

from __future__ import annotations

from dataclasses import dataclass

from slam.frames import RelativePose
from slam.frontend.failure import MeasurementFailure
from slam.frontend.lidar_odometry import LidarPath
from slam.frontend.scale.metric_scale import Scale
from slam.se3 import FloatArray


@dataclass(frozen=True)
class Measurements:
    """All relative poses with their noise, and the trajectories chained from them ``(N, 4, 4)``."""

    T_network: FloatArray
    lidar: LidarPath | MeasurementFailure | None
    scale: Scale
    factors: list[RelativePose]
    T_odometry: FloatArray
