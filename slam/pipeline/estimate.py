"""What is known of a drive before its pose graph, and the estimate that fits its measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.formats.trajectory import Trajectory
from slam.frames import Intrinsics, RelativePose, View
from slam.frontend.agreement import Agreement
from slam.frontend.drive import Drive
from slam.frontend.gps import Location
from slam.frontend.lidar_odometry import LidarPath
from slam.frontend.scale import Scale
from slam.geometry.se3 import FloatArray
from slam.graph.pose_graph import PoseGraph
from slam.loops.closure import LoopClosures
from slam.loops.places import Places
from slam.mapping.map import TsdfMap
from slam.runtime.errors import Failed
from slam.runtime.resources import Stopwatch


@dataclass(frozen=True)
class Odometry:
    """A completed drive, its factors in the unit of its scale, and ``T_world_camera`` ``(N, 4, 4)`` chained from them.

    ``lidar_steps`` are the steps by LiDAR that agree with the images, ``agreements`` those of all sources.
    """

    drive: Drive
    scale: Scale
    factors: list[RelativePose]
    T_world_camera: FloatArray
    lidar_steps: Sequence[RelativePose]
    agreements: Sequence[Agreement]

    def views(self) -> list[View]:
        """Those of the drive, their points in the unit of the trajectory."""
        return [view.scaled(float(self.scale.per_frame[view.index])) for view in self.drive.views]


@dataclass(frozen=True)
class Estimate:
    """Trajectories with one row a frame, the factors and loops they fit, the graph, and the map once it is fused.

    ``drive`` is completed, its rotations smoothed; the points of ``views`` are in the unit of the trajectories.
    ``graph`` is the reason where it has no solution: the optimised trajectory then is the odometry.
    ``location`` is None without a GPS track, and the reason where the track cannot be used. ``agreements`` say how far
    each optional source contradicts the images, ``confidence`` what follows from all of them, or why nothing does.
    """

    network: Trajectory
    odometry: Trajectory
    optimised: Trajectory
    lidar: LidarPath | Failed | None
    reference: Trajectory | None
    drive: Drive
    scale: Scale
    factors: list[RelativePose]
    views: list[View]
    loops: LoopClosures
    graph: PoseGraph | Failed
    location: Location | Failed | None
    stopwatch: Stopwatch
    confidence: float | Failed
    agreements: Sequence[Agreement] = ()
    map: TsdfMap | None = None

    def places(self, intrinsics: Intrinsics) -> Places:
        """Every view with its points at the poses of the optimised trajectory, and the camera."""
        frames = np.array([view.index for view in self.views], dtype=np.intp)
        return Places(intrinsics, tuple(self.views), self.optimised.T_world_camera[frames])
