"""All relative-pose factors of a run, made once from all measurements, and the odometry chained from them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam.frames import KEYFRAME_SOURCE, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.gaps import INTERPOLATED_SOURCE
from slam.frontend.keyframes.relative_poses import KeyframePoses
from slam.frontend.lidar_odometry import LIDAR_SOURCE
from slam.frontend.network_motion import (
    NETWORK_SOURCE,
    STUDENT_T_DOF,
    calibrate_network,
    network_factors,
)
from slam.frontend.scale import Scale
from slam.frontend.visual.noise import step_noise
from slam.geometry.se3 import FloatArray, compose, rigid

logger = logging.getLogger(__name__)


def make_factors(drive: Drive, scale: Scale, level: int = logging.INFO) -> list[RelativePose]:
    """All relative poses that the images give of a drive with their noise, in the unit of the scale.

    Args:
        drive: completed.
        scale: of that drive.
        level: of the line in the log that says what the pose network measured.
    """
    maps = drive.map_poses
    geometric = []
    noise = step_noise(drive.triangulated, len(scale.per_frame))
    for ends, motion in drive.steps.items():
        length = scale.lengths.get(ends)
        if motion.is_triangulated and length is not None:
            pose = motion.with_length(*length, noise[ends])
            geometric.append(replace(pose, student_t_dof=STUDENT_T_DOF))
        else:  # its length is that by learned depth
            geometric.append(scale.scaled(motion.relative_pose))
    by_keyframes = [scale.scaled(pose) for pose in maps.poses]
    calibration = calibrate_network(
        drive.network_steps, [*geometric, *by_keyframes], scale.per_frame
    )
    logger.log(level, "pose network: %s", calibration.over(scale.per_frame))
    networks = network_factors(drive.network_steps, calibration)
    if not calibration.is_measured:  # lengths in the wrong unit have no say beside measured ones
        by_geometry = {pose.ends for pose in geometric}
        networks = [factor for factor in networks if factor.ends not in by_geometry]
    by_network = _outside(maps, networks)
    by_image = _outside(maps, geometric)
    interpolated = _outside(maps, [scale.scaled(pose) for pose in drive.gap_steps])
    return [*by_network, *interpolated, *by_image, *by_keyframes]


def _outside(maps: KeyframePoses, poses: Sequence[RelativePose]) -> list[RelativePose]:
    """The poses between frames that do not both lie in one connected component of maps."""
    return [pose for pose in poses if not maps.is_inside(pose)]


def chain_odometry(factors: Sequence[RelativePose], count: int) -> FloatArray:
    """Odometry without a graph ``(count, 4, 4)``: each frame by the best factor that ends there.

    Args:
        factors: in one unit, from earlier to later frames; one at least ends at every frame but the
            first. Of several that are equally good and long, the last one is taken.
        count: frames.
    """
    by_precedence = sorted(factors, key=_precedence)
    arriving = {each.to_index: each for each in by_precedence if each.from_index < each.to_index}
    T_world_camera = np.tile(np.eye(4), (count, 1, 1))
    T_from_to = rigid(np.array([arriving[k].T_from_to for k in range(1, count)]).reshape(-1, 4, 4))
    for k, T_first_camera in enumerate(T_from_to, start=1):
        T_world_camera[k] = compose(T_world_camera[arriving[k].from_index], T_first_camera)
    return T_world_camera


def _precedence(factor: RelativePose) -> tuple[bool, bool, int, bool, bool]:
    """After a gap, a place in the map is known better than any motion over the gap; the network is known least.

    Of two other measurements of one step that by LiDAR replaces a guess, and images replace LiDAR.
    """
    source = factor.source
    by_map, by_network = source == KEYFRAME_SOURCE, source == NETWORK_SOURCE
    is_guess, by_lidar = source == INTERPOLATED_SOURCE, source == LIDAR_SOURCE
    return by_map, not by_network, factor.from_index, not is_guess, not by_lidar
