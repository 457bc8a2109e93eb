"""The unit of a run and the lengths of its steps, by mode: camera height over the ground plane, LiDAR, a reference.

Lengths are estimated in ``frontend/scale/step_lengths.py``; the mode decides which measurements are absolute.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from slam.config.sections import ScaleConfig, ScaleMode
from slam.frames import Ends, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.scale.road_plane import GroundPlane
from slam.frontend.scale.step_lengths import gather_evidence, solve_lengths
from slam.frontend.visual.motion import links, triangulated
from slam.geometry.robust import mad_sigma, running_median
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import Failed, SlamError

LengthUnit = Literal["metres", "camera heights", "no metric unit", "the networks' own unit"]

logger = logging.getLogger(__name__)
_LEAST_ROAD = 1 / 3  # of the frames, half of which have learned depth; fewer see a floor or a table now and then
_MAX_CONTRADICTION = 2.5  # largest factor between a measured length and that by learned depth
_REFERENCE_FRAMES = 50  # number of first frames that mode reference compares
_REJECTION_SIGMAS = 3.0  # distance from the median beyond which a frame is left out
MIN_FRAMES = 5  # least number of usable frames of a scale
_SMOOTHING_FRAMES = 41  # window over which the scale of a frame is averaged, frames


@dataclass(frozen=True)
class ScaleEstimate:
    """``value`` times an unscaled length is a length in the mode's unit.

    ``spread`` is the relative sigma of the values of single frames.
    """

    value: float
    spread: float
    frames_used: int


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


def resolve_mode(config: ScaleConfig, camera_height_m: float | None, has_gps: bool = False) -> ScaleMode:
    """The mode, with ``auto`` resolved: camera-height where the height is known, else gps where there is, else none."""
    if config.mode != "auto":
        return config.mode
    if camera_height_m is not None:
        return "camera-height"
    return "gps" if has_gps else "none"


def scale_from_road(roads: Sequence[GroundPlane | Failed], height: float = 1.0) -> ScaleEstimate | Failed:
    """Unit of the camera's ``height`` per unscaled length: metres, or camera heights where it is 1.

    The median over the frames without outliers, which are many MADs away.
    """
    ratios = _ratios(roads, height)
    logarithms = np.log(ratios[np.isfinite(ratios)])
    if len(logarithms) < MIN_FRAMES:
        return Failed(f"only {len(logarithms)} frames measure the scale, {MIN_FRAMES} are needed")
    deviations = np.abs(logarithms - np.median(logarithms))
    kept = logarithms[deviations <= _REJECTION_SIGMAS * mad_sigma(deviations) + 1e-12]
    spread = mad_sigma(kept - np.median(kept))
    return ScaleEstimate(float(np.exp(np.median(kept))), spread, len(kept))


def scale_from_reference(
    T_world_camera_unscaled: FloatArray, T_world_camera_true: FloatArray
) -> ScaleEstimate | Failed:
    """True path length over estimated path length of the first 50 frames."""
    estimated, true = (
        np.linalg.norm(np.diff(T[:_REFERENCE_FRAMES, :3, 3], axis=0), axis=1)
        for T in (T_world_camera_unscaled, T_world_camera_true)
    )
    if estimated.sum() <= 0 or true.sum() <= 0:
        return Failed(f"the camera does not move within the first {_REFERENCE_FRAMES} frames")
    value = float(true.sum() / estimated.sum())
    moving = estimated > 0.1 * estimated.mean()
    spread = float(np.std(true[moving] / estimated[moving] / value))
    return ScaleEstimate(value, spread, len(estimated) + 1)


def known_frames(config: ScaleConfig, stamps: FloatArray) -> tuple[int, int]:
    """The two frames of mode known, at the frames' ``stamps`` ``(N,)``.

    Raises:
        SlamError: a frame or stamp outside the drive, or twice the same frame.
    """
    found = []
    for end in config.known_between or ():
        if isinstance(end, int):
            index, inside = end, end < len(stamps)
        else:
            stamp = float(end.removesuffix("s"))
            index, inside = int(np.abs(stamps - stamp).argmin()), bool(stamps[0] <= stamp <= stamps[-1])
        if not inside:
            raise SlamError(
                f"scale.known_between names {end}, but the drive has frames 0 to {len(stamps) - 1} "
                f"at {stamps[0]:.3f} to {stamps[-1]:.3f} s: choose two of these"
            )
        found.append(index)
    first, second = found
    if first == second:
        raise SlamError(
            f"scale.known_between names frame {first} twice: choose two frames with a distance between them"
        )
    return first, second


def scale_from_distance(
    T_world_camera_unscaled: FloatArray, stamps: FloatArray, config: ScaleConfig
) -> ScaleEstimate | Failed:
    """The known distance of two frames over their estimated distance; raises as `known_frames`."""
    first, second = known_frames(config, stamps)
    apart = np.linalg.norm(T_world_camera_unscaled[second, :3, 3] - T_world_camera_unscaled[first, :3, 3])
    if config.known_m is None or not apart > 0:
        return Failed(f"the camera does not move between frames {first} and {second}")
    return ScaleEstimate(config.known_m / float(apart), 0.0, 2)


def scale_track(roads: Sequence[GroundPlane | Failed], height: float, estimate: ScaleEstimate) -> FloatArray:
    """The scale near each frame ``(N,)``: a running median over ground planes.

    The unit of learned depth drifts along a drive. Where the 41 frames around a frame hold too few
    usable planes, the estimate of the whole drive is used.
    """
    ratios = _ratios(roads, height)
    bound = _REJECTION_SIGMAS * max(estimate.spread, 0.02)
    ratios[np.abs(np.log(ratios / estimate.value)) > bound] = np.nan
    known = np.pad(np.isfinite(ratios), _SMOOTHING_FRAMES // 2)
    counts = np.lib.stride_tricks.sliding_window_view(known, _SMOOTHING_FRAMES).sum(axis=1)
    return np.where(counts >= MIN_FRAMES, running_median(ratios, _SMOOTHING_FRAMES), estimate.value)


def _ratios(roads: Sequence[GroundPlane | Failed], height: float) -> FloatArray:
    """The camera's height over that above each ground plane ``(N,)``, NaN without one."""
    return np.array([height / r.height_unscaled if isinstance(r, GroundPlane) else np.nan for r in roads])
