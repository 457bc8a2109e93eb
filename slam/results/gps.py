"""A run beside its GPS track: errors for ``metrics.json``, and its place on the earth."""

from __future__ import annotations

import numpy as np

from slam.formats.trajectory import Trajectory
from slam.frontend import gps
from slam.frontend.failure import MeasurementFailure
from slam.geometry.se3 import FloatArray
from slam.pipeline.estimate import Estimate
from slam.pipeline.positioning import Location
from slam.results.metrics import GpsErrors, GpsMetrics, Origin
from slam.runtime.attempt import Failed


def gps_metrics(result: Estimate, in_graph: bool) -> GpsMetrics | Failed:
    """Distances of odometry and optimised trajectory from the fixes, and the place of the first camera."""
    location = result.location
    if not isinstance(location, Location):
        return location or Failed("no GPS track was given")
    T_enu_first = location.T_enu_world @ result.optimised.T_world_camera[0]
    latitude, longitude, height = location.fixes.frame.places(T_enu_first[None, :3, 3])[0].tolist()
    ahead = T_enu_first[:3, 2]
    heading = float(np.rad2deg(np.arctan2(ahead[0], ahead[1])) % 360.0)
    aligned = gps.align(location.fixes, result.odometry.T_world_camera, result.odometry.stamps)
    return GpsMetrics.of(
        fixes=len(location.fixes.stamps),
        in_graph=in_graph,
        origin=Origin(latitude_deg=latitude, longitude_deg=longitude, altitude_m=height, heading_deg=heading),
        odometry=aligned
        if isinstance(aligned, MeasurementFailure)
        else _errors(location.fixes, aligned, result.odometry),
        optimised=_errors(location.fixes, location.T_enu_world, result.optimised),
    )


def _errors(fixes: gps.GpsFixes, T_enu_world: FloatArray, trajectory: Trajectory) -> GpsErrors:
    apart = gps.offsets(fixes, T_enu_world @ trajectory.T_world_camera, trajectory.stamps)
    level = np.linalg.norm(apart[:, :2], axis=1)
    return GpsErrors(
        horizontal_rmse_m=float(np.sqrt((level**2).mean())),
        horizontal_median_m=float(np.median(level)),
        vertical_rmse_m=float(np.sqrt((apart[:, 2] ** 2).mean())),
    )
