"""The unit of a run and the length of its steps, by a named mode: the road below the camera, LiDAR, a reference.

What measures is told in ``frontend/scale/step_lengths.py``; here the mode says which of it is in the unit wanted.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam.config import LengthConfig, LidarConfig, ScaleConfig, ScaleMode
from slam.frames import RelativePose
from slam.frontend.failure import MeasurementFailure
from slam.frontend.scale.road_homography import RoadStep
from slam.frontend.scale.road_plane import GroundPlane, ScaleEstimate, scale_from_road, scale_track
from slam.frontend.scale.step_lengths import gather_evidence, solve_lengths
from slam.frontend.visual.odometry import Motion
from slam.robust import mad_sigma
from slam.se3 import FloatArray

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Scale:
    """``per_frame`` ``(N,)`` times an unscaled length near that frame is a length in the mode's unit.

    ``lengths`` ``(N - 1,)`` are those of the steps between frames, NaN where only the networks measured them, and
    ``length_sigmas`` ``(N - 1,)`` their relative sigmas, ``length_correlated_sigmas`` the sigmas of independent errors
    that would add up along the drive as these correlated ones do.
    """

    mode: ScaleMode
    estimate: ScaleEstimate | MeasurementFailure
    per_frame: FloatArray
    lengths: FloatArray
    length_sigmas: FloatArray
    length_correlated_sigmas: FloatArray

    def in_unit_of(self, other: ScaleEstimate | MeasurementFailure) -> Scale:
        """The same lengths times an estimate that was made in this unit; unchanged by a refusal."""
        if isinstance(other, MeasurementFailure):
            return replace(self, estimate=other)
        per_frame = other.value * self.per_frame
        estimate = replace(other, value=float(np.median(per_frame)))
        return replace(self, estimate=estimate, per_frame=per_frame, lengths=other.value * self.lengths)


@dataclass(frozen=True)
class LengthMeasurements:
    """What one pass measured: learned road planes by frame; motions and road steps by the step's first frame."""

    planes: Sequence[GroundPlane | MeasurementFailure]
    motions: Mapping[int, Motion]
    road_steps: Mapping[int, RoadStep]
    lidar_steps: Sequence[RelativePose] = ()


def find_scale(
    mode: ScaleMode,
    camera_height_m: float | None,
    measured: LengthMeasurements,
    config: ScaleConfig,
    lengths: LengthConfig,
    lidar: LidarConfig,
) -> Scale:
    """All lengths of a run in metres, or in camera heights where no mode gives metres (none, reference)."""
    metres = {pose.from_index: float(np.linalg.norm(pose.T_from_to[:3, 3])) for pose in measured.lidar_steps}
    height = camera_height_m if mode == "camera-height" else None
    if mode == "lidar":
        height = _height_by_lidar(metres, measured.road_steps) or camera_height_m
    unit = 1.0 if height is None else height
    absolute = {k: (unit * road.length_heights, road.relative_sigma) for k, road in measured.road_steps.items()}
    if mode == "lidar":
        absolute |= {k: (length, lidar.translation_sigma_m / length) for k, length in metres.items() if length > 0}
    believed = scale_from_road(measured.planes, height, config)
    frames = len(measured.planes)
    if isinstance(believed, MeasurementFailure):
        unit_believed = np.full(frames, _unit_by_steps(measured.motions, absolute))
    elif absolute:
        # steps of known length tell how the unit wanders, and rain or a car ahead bends the learned road
        unit_believed = np.full(frames, believed.value)
    else:
        unit_believed = scale_track(measured.planes, height, believed, config)
    evidence = gather_evidence(measured.motions, absolute, unit_believed)
    if not isinstance(believed, MeasurementFailure):
        # a car ahead that is taken for the road, for seconds on end, would outvote everything else
        evidence = evidence.without_contradicted(lengths.max_contradiction)
    solved = solve_lengths(evidence, lengths)
    per_frame = unit_believed * np.append(solved.unit_correction, solved.unit_correction[-1])
    misfit = np.abs(evidence.absolute - np.log(solved.length))
    used = int(np.isfinite(misfit).sum())
    estimate = believed
    if used >= config.min_frames:
        spread = mad_sigma(misfit[np.isfinite(misfit)])
        estimate = ScaleEstimate(float(np.median(per_frame)), spread, used)
    elif isinstance(believed, MeasurementFailure):
        logger.warning("no scale (%s): lengths stay in the networks' unit", believed.reason)
    return Scale(mode, estimate, per_frame, solved.length, solved.relative_sigma, solved.relative_correlated_sigma)


def _height_by_lidar(metres: Mapping[int, float], road_steps: Mapping[int, RoadStep]) -> float | None:
    """The camera's height from steps that LiDAR and road both measured."""
    heights = [metres[k] / road.length_heights for k, road in road_steps.items() if k in metres]
    return float(np.median(heights)) if heights else None


def _unit_by_steps(motions: Mapping[int, Motion], absolute: Mapping[int, tuple[float, float]]) -> float:
    """Unit of learned depth from steps of known length; 1 where there are none."""
    ratios = [
        absolute[k][0] / float(np.linalg.norm(motion.relative_pose.T_from_to[:3, 3]))
        for k, motion in motions.items()
        if k in absolute
    ]
    return float(np.median(ratios)) if ratios else 1.0
