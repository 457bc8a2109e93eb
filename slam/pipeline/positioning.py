"""A drive on the earth, by its GPS track."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from slam.config.sections import GpsConfig, ScaleMode
from slam.frontend import agreement, gps
from slam.frontend.agreement import Agreement
from slam.frontend.scale.scale_estimate import ScaleEstimate
from slam.geometry.geodesy import GpsTrack
from slam.geometry.se3 import FloatArray, path_distance
from slam.graph.pose_graph import PoseGraph
from slam.runtime.errors import Failed, SlamError

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Location:
    """The fixes of a drive, and ``T_enu_world`` ``(4, 4)``: the world in axes east, north, up."""

    fixes: gps.GpsFixes
    T_enu_world: FloatArray


class Positioning:
    """The GPS track of one drive; ``stamps`` ``(N,)`` are the stamps of its frames."""

    def __init__(self, track: GpsTrack, stamps: FloatArray, config: GpsConfig, mode: ScaleMode) -> None:
        """Match a track to a drive.

        Raises:
            SlamError: lengths are not in metres, or fewer than three fixes were taken during the drive.
        """
        if mode == "none":
            raise SlamError("a GPS track is in metres: choose scale.mode=gps with it, or another mode in metres")
        fixes = gps.fixes_of(track, stamps, config)
        if isinstance(fixes, Failed):
            raise SlamError(fixes.reason)
        self._fixes, self._stamps, self._config, self._mode = fixes, stamps, config, mode
        self.agreement: Agreement | None = None

    def scale(self, T_odometry: FloatArray) -> ScaleEstimate | Failed:
        """Metres per unit of an odometry ``(N, 4, 4)``."""
        return gps.scale_by_gps(self._fixes, T_odometry, self._stamps)

    def locate(self, T_world_camera: FloatArray, scale: ScaleEstimate | Failed) -> Location | Failed:
        """Where a trajectory ``(N, 4, 4)`` lies on the earth; a failure is logged, as that of its scale was."""
        if isinstance(scale, Failed):
            return scale
        T_enu_world: FloatArray | Failed = gps.align(self._fixes, T_world_camera, self._stamps)
        if not isinstance(T_enu_world, Failed):
            T_enu_world = self._agreeing(T_enu_world, T_world_camera)
        if isinstance(T_enu_world, Failed):
            logger.warning("the GPS track is not used: %s", T_enu_world.reason)
            return T_enu_world
        return Location(self._fixes, T_enu_world)

    def _agreeing(self, T_enu_world: FloatArray, T_world_camera: FloatArray) -> FloatArray | Failed:
        """The same pose, unless the fixes contradict the path; a run whose lengths are theirs is then refused."""
        apart = gps.offsets(self._fixes, T_enu_world @ T_world_camera, self._stamps)
        distances, path_m = np.linalg.norm(apart[:, :2], axis=1), float(path_distance(T_world_camera)[-1])
        found = agreement.of_positions("GPS", distances, self._fixes.sigmas[:, 0], path_m)
        self.agreement = found
        if found.is_wrong and self._mode == "gps":
            raise SlamError(f"{found}; give the track and gps.offset_s of this drive, or another scale.mode")
        return Failed(str(found)) if found.is_wrong else T_enu_world

    def add_factors(self, graph: PoseGraph, location: Location, T_odometry: FloatArray) -> None:
        """Add the fixes to a graph, unless they are only for comparison."""
        if self._config.factors:
            positions = gps.positions_at_frames(self._fixes, location.T_enu_world, T_odometry, self._stamps)
            graph.add_positions(positions, location.T_enu_world)

    def relocated(self, graph: PoseGraph, T_optimised: FloatArray, scale: ScaleEstimate | Failed) -> Location | Failed:
        """The location of the optimised trajectory ``(N, 4, 4)``."""
        if self._config.factors:
            return Location(self._fixes, graph.T_fixed_world)
        return self.locate(T_optimised, scale)
