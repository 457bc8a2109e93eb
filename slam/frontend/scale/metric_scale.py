"""The unit of a run and the lengths of its steps, by mode: camera height over the ground plane, LiDAR, a reference.

Lengths are estimated in ``frontend/scale/step_lengths.py``; the mode decides which measurements are absolute.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from slam.config.sections import ScaleMode
from slam.frames import Ends, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.scale.road_plane import GroundPlane
from slam.frontend.scale.scale_estimate import MIN_FRAMES, ScaleEstimate, scale_from_road, scale_track
from slam.frontend.scale.step_lengths import gather_evidence, solve_lengths
from slam.frontend.visual.motion import links, triangulated
from slam.geometry.robust import mad_sigma
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import Failed

LengthUnit = Literal["metres", "camera heights", "no metric unit", "the networks' own unit"]

logger = logging.getLogger(__name__)
_LEAST_ROAD = 1 / 3  # of the frames, half of which have learned depth; fewer see a floor or a table now and then
_MAX_CONTRADICTION = 2.5  # largest factor between a measured length and that by learned depth


class StepLength(NamedTuple):
    """A length, its relative sigma, and the sigma of independent errors that add up as its correlated ones do."""

    value: float
    relative_sigma: float
    relative_correlated_sigma: float


@dataclass(frozen=True)
class Scale:
    """``per_frame`` ``(N,)`` times an unscaled length near that frame is a length in ``unit``.

    ``lengths`` of the steps that image geometry measured are in ``unit``. ``estimate`` is that of the mode's unit, or
    why there is none.
    """

    mode: ScaleMode
    estimate: ScaleEstimate | Failed
    per_frame: FloatArray
    lengths: Mapping[Ends, StepLength]
    unit: LengthUnit
    contradicted: Sequence[Ends] = ()

    @property
    def is_metric(self) -> bool:
        """Whether lengths are metres."""
        return self.unit == "metres"

    @property
    def unit_name(self) -> str | None:
        """``m``, with mode none ``unit``; None where metres were not found."""
        return "m" if self.is_metric else self.unit if self.mode == "none" else None

    def in_metres(self, other: ScaleEstimate | Failed) -> Scale:
        """In metres, by those per unit of this scale; where they were not found the unit stays."""
        if isinstance(other, Failed):
            logger.warning("no scale (%s): lengths stay in %s", other.reason, self.unit)
            return replace(self, estimate=other)
        per_frame = other.value * self.per_frame
        estimate = replace(other, value=float(np.median(per_frame)))
        lengths = {ends: length._replace(value=other.value * length.value) for ends, length in self.lengths.items()}
        return replace(self, estimate=estimate, per_frame=per_frame, lengths=lengths, unit="metres")

    def scaled(self, measured: RelativePose) -> RelativePose:
        """An unscaled measurement in the mode's unit at its first frame."""
        return measured.scaled(float(self.per_frame[min(measured.ends)]))


def find_scale(
    mode: ScaleMode,
    camera_height_m: float | None,
    drive: Drive,
    lidar_steps: Sequence[RelativePose],
) -> Scale:
    """All lengths of a run in metres, or in camera heights where no mode gives metres (none, reference, known, gps).

    Without a road in most frames, the planes that were found give no unit that means anything.
    """
    motions, frames = triangulated(drive.steps), len(drive)
    metres = _lengths(lidar_steps)
    height = camera_height_m if mode == "camera-height" else None
    if mode == "lidar":
        height = height_by_lidar(lidar_steps, drive) or camera_height_m
    unit = 1.0 if height is None else height
    absolute = {ends: (unit * road.length_heights, road.relative_sigma) for ends, road in drive.road_steps.items()}
    if mode == "lidar":
        sigmas = {pose.ends: float(pose.sigmas[3]) for pose in lidar_steps}
        absolute |= {ends: (length, sigmas[ends] / length) for ends, length in metres.items() if length > 0}
    by_planes = scale_from_road(drive.roads, unit)
    if isinstance(by_planes, Failed):
        ratios = [absolute[ends][0] / motion.length_unscaled for ends, motion in motions.items() if ends in absolute]
        prior_unit = np.full(frames, float(np.median(ratios)) if ratios else 1.0)
    elif absolute:
        # steps of known length measure the drift of the unit; rain or a car ahead biases the learned ground plane
        prior_unit = np.full(frames, by_planes.value)
    else:
        prior_unit = scale_track(drive.roads, unit, by_planes)
    steps = links(motions, frames)
    evidence = gather_evidence(steps, motions, absolute, prior_unit, unit)
    if not isinstance(by_planes, Failed):
        # a car ahead taken for the road for seconds would outweigh all other measurements
        evidence.absolute[np.abs(evidence.absolute - evidence.learned) > np.log(_MAX_CONTRADICTION)] = np.nan
    solved = solve_lengths(evidence)
    row_at = np.searchsorted([first for first, _ in steps], np.arange(frames), side="right") - 1
    per_frame = prior_unit * solved.unit_correction[row_at]
    misfit = np.abs(evidence.absolute - np.log(solved.length))
    used = int(np.isfinite(misfit).sum())
    estimate = by_planes
    is_metric = height is not None or (mode == "lidar" and len(metres) > 0)
    named: LengthUnit = "metres" if is_metric else "camera heights"
    if used >= MIN_FRAMES:
        spread = mad_sigma(misfit[np.isfinite(misfit)])
        estimate = ScaleEstimate(float(np.median(per_frame)), spread, used)
    elif isinstance(by_planes, Failed):
        named = "the networks' own unit"
        logger.warning("no scale (%s): lengths stay in %s", by_planes.reason, named)
    # by learned depth, or by the homography of steps
    with_road = max(used, 0 if isinstance(by_planes, Failed) else by_planes.frames_used)
    if named == "camera heights" and with_road < _LEAST_ROAD * frames:
        named = "no metric unit"
    contradicted = [ends for ends, is_so in zip(steps, solved.contradicted, strict=True) if is_so]
    rows = zip(steps, solved.length, solved.relative_sigma, solved.relative_correlated_sigma, strict=True)
    lengths = {ends: StepLength(*map(float, row)) for ends, *row in rows if np.isfinite(row[0])}
    return Scale(mode, estimate, per_frame, lengths, named, contradicted)


def _lengths(steps: Sequence[RelativePose]) -> dict[Ends, float]:
    return {pose.ends: float(np.linalg.norm(pose.T_from_to[:3, 3])) for pose in steps}


def height_by_lidar(lidar_steps: Sequence[RelativePose], drive: Drive) -> float | None:
    """The camera's height from steps measured by LiDAR and the road, or else by learned planes; None without both."""
    metres = _lengths(lidar_steps)
    roads = drive.road_steps
    heights = [metres[ends] / roads[ends].length_heights for ends in roads if ends in metres]
    if not heights:
        heights = [
            metres[ends] / motion.length_unscaled * plane.height_unscaled
            for ends, motion in triangulated(drive.steps).items()
            if ends in metres and isinstance(plane := drive.roads[ends[0]], GroundPlane)
        ]
    return float(np.median(heights)) if heights else None
