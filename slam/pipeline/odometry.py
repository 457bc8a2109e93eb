"""What is known of a drive before its pose graph, and after it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from slam.formats.trajectory import Trajectory
from slam.frames import RelativePose, View
from slam.frontend.agreement import Agreement
from slam.frontend.drive import Drive
from slam.frontend.failure import MeasurementFailure
from slam.frontend.lidar_odometry import LidarPath
from slam.frontend.scale.metric_scale import Scale
from slam.geometry.se3 import FloatArray
from slam.graph.pose_graph import PoseGraph
from slam.loops.closure import LoopClosures
from slam.pipeline.positioning import Location
from slam.runtime.storage.record import Missing

Keep = Callable[[str, Trajectory], None]  # is given a trajectory by its name


def keep_nothing(name: str, trajectory: Trajectory) -> None:
    """Nobody wants trajectories before the end."""


@dataclass(frozen=True)
class Odometry:
    """A completed drive, its lengths and factors, and ``T_world_camera`` ``(N, 4, 4)`` chained from these.

    Beside them the chain ``T_network`` ``(N, 4, 4)`` of the pose network alone, unscaled, the path by LiDAR and the
    steps of it that agree with the images; ``agreements`` are of all sources.
    """

    drive: Drive
    T_network: FloatArray
    lidar: LidarPath | MeasurementFailure | None
    lidar_steps: Sequence[RelativePose]
    scale: Scale
    factors: list[RelativePose]
    T_world_camera: FloatArray
    agreements: tuple[Agreement, ...]

    def views(self) -> list[View]:
        """Those of the drive, their points in the unit of the trajectory."""
        return [view.scaled(float(self.scale.per_frame[view.index])) for view in self.drive.views]


@dataclass(frozen=True)
class Solution:
    """What the pose graph gives, or why there is none: ``T_world_camera`` ``(N, 4, 4)`` then is the odometry."""

    graph: PoseGraph | Missing
    T_world_camera: FloatArray
    loops: LoopClosures
    location: Location | MeasurementFailure | None
