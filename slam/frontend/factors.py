"""All relative-pose factors of a run, made once from all measurements, and the odometry chained from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from erfsfm.pose_noise import PoseNoise
from slam.config.sections import PoseNetworkConfig, VisualOdometryConfig
from slam.frames import KEYFRAME_SOURCE, Ends, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.gap_interpolation import INTERPOLATED_SOURCE
from slam.frontend.keyframes.gaps import join_gap_ends
from slam.frontend.keyframes.relative_poses import KeyframePoses
from slam.frontend.network_factors import (
    NETWORK_SOURCE,
    STUDENT_T_DOF,
    calibrated_factors,
    measured_noise,
    network_factors,
    without_measured,
)
from slam.frontend.scale.metric_scale import Scale
from slam.frontend.step_table import StepTable, links
from slam.frontend.visual.step_noise import StepNoise, inflate_step_sigmas
from slam.geometry.se3 import FloatArray, compose, invert, rigid


def make_factors(
    drive: Drive,
    scale: Scale,
    noise: PoseNoise | None,
    pose_network: PoseNetworkConfig,
    visual_odometry: VisualOdometryConfig,
) -> list[RelativePose]:
    """All relative poses with their noise, in the unit of the scale.

    Args:
        drive: completed.
        scale: of each frame, and the lengths of steps.
        noise: of the pose network; None measures it against image geometry on this drive.
        pose_network: which of its factors are used.
        visual_odometry: noise of image geometry.
    """
    geometric = _geometric(drive.steps, scale, visual_odometry)
    # the noise of the networks is that of their own unit
    unscaled = [pose.scaled(1.0 / scale.unit_at(pose)) for pose in geometric]
    if noise is None:
        networks = network_factors(drive.trusted, measured_noise(drive.trusted, unscaled))
    else:
        networks = calibrated_factors(drive.trusted, unscaled, noise)
    if pose_network.use == "gaps" or (pose_network.use == "calibrated" and noise is None):
        networks = without_measured(networks, geometric)
    maps = drive.map_poses

    def outside(poses: Sequence[RelativePose]) -> list[RelativePose]:
        return [pose for pose in poses if not maps.is_inside(pose)]

    by_network, interpolated = (
        [scale.scaled(pose) for pose in outside(poses)] for poses in (networks, drive.gap_steps)
    )
    by_image, by_keyframes = outside(geometric), scaled_poses(maps.poses, maps, scale)
    interpolated = join_gap_ends(interpolated, [*by_network, *by_image], by_keyframes, maps.segments)
    return [*by_network, *interpolated, *by_image, *by_keyframes]


def scaled_steps(drive: Drive, scale: Scale) -> list[RelativePose]:
    """Interpolated steps and those of image geometry in the unit of the scale, without the noise of a graph."""
    steps = [scale.scaled(pose) for pose in drive.gap_steps]
    for ends, motion in drive.steps.motions.items():
        length, pose = scale.lengths.get(ends) if motion.is_triangulated else None, motion.relative_pose
        steps.append(scale.scaled(pose) if length is None else pose.scaled(length.value / motion.length_unscaled))
    return steps


def with_lidar(factors: Sequence[RelativePose], lidar_steps: Sequence[RelativePose]) -> list[RelativePose]:
    """The factors with LiDAR steps, all in metres, before those of image geometry, by which odometry is chained."""
    less_certain = (NETWORK_SOURCE, INTERPOLATED_SOURCE)
    before = [factor for factor in factors if factor.source in less_certain]
    return [*before, *lidar_steps, *(factor for factor in factors if factor.source not in less_certain)]


def scaled_poses(poses: Sequence[RelativePose], maps: KeyframePoses, scale: Scale) -> list[RelativePose]:
    """Poses by keyframes in the unit of the scale: one factor for each map, in which lengths are consistent."""
    units = {number: maps.learned_units[number] * unit for number, unit in depth_units(maps, scale).items()}
    return [pose.scaled(units[maps.segments[pose.from_index]]) for pose in poses]


def depth_units(maps: KeyframePoses, scale: Scale) -> dict[int, float]:
    """The unit of the scale per learned depth in each map, by the map's number."""
    numbers = set(maps.segments.values())
    return {number: float(np.median(scale.per_frame[maps.frames_of(number)])) for number in numbers}


def chain_odometry(factors: Sequence[RelativePose], T_network: FloatArray, scale: Scale) -> FloatArray:
    """Odometry without a graph ``(N, 4, 4)``: each frame by the geometric step that ends there, else the network.

    Args:
        factors: in the unit of the scale; of several of equal length that end at a frame, the last one is taken.
        T_network: the raw network trajectory, unscaled.
        scale: of the network's steps.
    """
    arriving: dict[int, RelativePose] = {}
    for factor in factors:
        first, last = factor.ends
        if factor.source == NETWORK_SOURCE or first >= last:
            continue
        # after a gap, a place in the map is known better than any motion over the gap
        if last not in arriving or _precedence(factor) >= _precedence(arriving[last]):
            arriving[last] = factor
    increments = invert(T_network[:-1]) @ T_network[1:]
    increments[:, :3, 3] *= scale.per_frame[:-1, None]
    before = np.arange(len(increments))
    for k, step in arriving.items():
        before[k - 1], increments[k - 1] = step.from_index, step.T_from_to
    T_world_camera = np.tile(np.eye(4), (len(T_network), 1, 1))
    for k, (first, T_first_camera) in enumerate(zip(before.tolist(), rigid(increments), strict=True), start=1):
        T_world_camera[k] = compose(T_world_camera[first], T_first_camera)
    return T_world_camera


def _precedence(factor: RelativePose) -> tuple[bool, int]:
    return factor.source == KEYFRAME_SOURCE, factor.from_index


def _geometric(steps: StepTable, scale: Scale, config: VisualOdometryConfig) -> list[RelativePose]:
    """Every step of image geometry: with its own length where that was measured, else by learned depth."""
    noise = _step_noise(steps, scale, config)
    factors = []
    for ends, motion in steps.motions.items():
        length = scale.lengths.get(ends)
        if not motion.is_triangulated or length is None:
            factors.append(scale.scaled(motion.relative_pose))
            continue
        pose = motion.with_length(length.value, length.relative_sigma, length.relative_correlated_sigma, noise[ends])
        factors.append(replace(pose, student_t_dof=STUDENT_T_DOF))
    return factors


def _step_noise(steps: StepTable, scale: Scale, config: VisualOdometryConfig) -> Mapping[Ends, StepNoise]:
    """Noise of the triangulated steps besides that of the corners, by their order in the drive."""
    motions = steps.triangulated
    place = {ends: n for n, ends in enumerate(links(motions, len(scale.per_frame))) if ends in motions}
    T_by_place = {n: motions[ends].relative_pose.T_from_to for ends, n in place.items()}
    own = {n: motions[ends].own_noise for ends, n in place.items()}
    inflated = inflate_step_sigmas(T_by_place, own, config)
    return {ends: inflated[n] for ends, n in place.items()}
