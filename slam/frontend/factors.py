"""All relative-pose factors of a run, made once from all measurements, and the odometry chained from them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam.frames import KEYFRAME_SOURCE, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.gap_interpolation import join_gap_ends
from slam.frontend.keyframes.relative_poses import KeyframePoses
from slam.frontend.network_factors import (
    NETWORK_SOURCE,
    STUDENT_T_DOF,
    calibrate_network,
    network_factors,
    network_steps,
)
from slam.frontend.scale.metric_scale import Scale
from slam.frontend.visual.motion import Steps, triangulated
from slam.frontend.visual.step_noise import step_noise
from slam.geometry.se3 import FloatArray, compose, rigid

logger = logging.getLogger(__name__)


def make_factors(
    drive: Drive, scale: Scale, lidar_steps: Sequence[RelativePose] = (), level: int = logging.INFO
) -> list[RelativePose]:
    """All relative poses of a completed drive with their noise, in the unit of the scale.

    The least certain come first, and odometry is chained by the last ones; steps by LiDAR, in metres, stand before
    those of image geometry. What the pose network measured is a line in the log of this ``level``.
    """
    maps = drive.map_poses
    geometric = _geometric(drive.steps, scale)
    by_keyframes = scaled_poses(maps.poses, maps, scale)
    steps = network_steps(drive.trusted)
    calibration = calibrate_network(steps, [*geometric, *by_keyframes], scale.per_frame)
    logger.log(level, "pose network: %s", calibration.over(scale.per_frame))
    networks = network_factors(steps, calibration)
    if not calibration.is_measured:  # lengths in the wrong unit have no say beside measured ones
        by_geometry = {pose.ends for pose in geometric}
        networks = [factor for factor in networks if factor.ends not in by_geometry]
    interpolated = [scale.scaled(pose) for pose in drive.gap_steps]
    by_network, interpolated, by_image = (
        [pose for pose in poses if not maps.is_inside(pose)] for poses in (networks, interpolated, geometric)
    )
    interpolated = join_gap_ends(interpolated, [*by_network, *by_image], by_keyframes, maps.segments)
    return [*by_network, *interpolated, *lidar_steps, *by_image, *by_keyframes]


def scaled_poses(poses: Sequence[RelativePose], maps: KeyframePoses, scale: Scale) -> list[RelativePose]:
    """Poses by keyframes in the unit of the scale: one factor for each map, in which lengths are consistent."""
    units = {}
    for segment in set(maps.segments.values()):
        frames = [frame for frame, number in maps.segments.items() if number == segment]
        units[segment] = maps.learned_units[segment] * float(np.median(scale.per_frame[frames]))
    return [pose.scaled(units[maps.segments[pose.from_index]]) for pose in poses]


def chain_odometry(factors: Sequence[RelativePose], count: int) -> FloatArray:
    """Odometry without a graph ``(count, 4, 4)``: each frame by the best factor that ends there.

    Args:
        factors: in one unit, from earlier to later frames; one at least ends at every frame but the first. Of several
            that are equally good and long, the last one is taken.
        count: frames.
    """
    arriving: dict[int, RelativePose] = {}
    for factor in factors:
        first, last = factor.ends
        if first < last and (last not in arriving or _precedence(factor) >= _precedence(arriving[last])):
            arriving[last] = factor
    T_world_camera = np.tile(np.eye(4), (count, 1, 1))
    T_from_to = rigid(np.array([arriving[k].T_from_to for k in range(1, count)]).reshape(-1, 4, 4))
    for k, T_first_camera in enumerate(T_from_to, start=1):
        T_world_camera[k] = compose(T_world_camera[arriving[k].from_index], T_first_camera)
    return T_world_camera


def _precedence(factor: RelativePose) -> tuple[bool, bool, int]:
    """After a gap, a place in the map is known better than any motion over the gap; the network is known least."""
    return factor.source == KEYFRAME_SOURCE, factor.source != NETWORK_SOURCE, factor.from_index


def _geometric(steps: Steps, scale: Scale) -> list[RelativePose]:
    """Every step of image geometry: with its own length where that was measured, else by learned depth."""
    noise = step_noise(triangulated(steps), len(scale.per_frame))
    factors = []
    for ends, motion in steps.items():
        length = scale.lengths.get(ends)
        if not motion.is_triangulated or length is None:
            factors.append(scale.scaled(motion.relative_pose))
            continue
        pose = motion.with_length(*length, noise[ends])
        factors.append(replace(pose, student_t_dof=STUDENT_T_DOF))
    return factors
