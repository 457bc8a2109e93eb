"""GPS beside the camera: where its axes east, north, up lie, the scale by it, and positions for the graph.

Fixes of a receiver share most of their error for seconds to minutes. So their sigmas are widened as if only one fix in
``correlation_s`` were independent.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from slam.config.sections import GpsConfig
from slam.formats.trajectory import nearest_stamps
from slam.frames import MeasuredPosition
from slam.frontend.scale.scale_estimate import MIN_FRAMES, ScaleEstimate
from slam.geometry import se3
from slam.geometry.geodesy import GpsTrack, LocalFrame
from slam.geometry.robust import mad_sigma
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import Failed

logger = logging.getLogger(__name__)

_LEAST_FIXES = 3
_CHORDS = 10  # the path is divided into about so many chords to compare lengths
_LEAST_MOTION_SIGMAS = 5.0
_GOOD_CHORD_SIGMAS = 20.0  # fixes with sigmas of 2.5 and 5 m lengthen such a chord by 1 %
_UP_SIGMA = 0.2  # radians between the camera's own up and that of the earth
_ROUNDS = 30
_HUBER_K = 1.345


@dataclass(frozen=True)
class GpsFixes:
    """The fixes taken during a drive.

    Attributes:
        stamps: seconds ``(M,)`` on the clock of the images.
        points: east, north, up ``(M, 3)``, metres; the antenna is taken to be at the camera.
        sigmas: of single fixes ``(M, 3)``, metres.
        widening: factor on the sigmas for a graph, which takes errors as independent.
        frame: where east, north, up begin.
    """

    stamps: FloatArray
    points: FloatArray
    sigmas: FloatArray
    widening: float
    frame: LocalFrame

    def camera(self, T_any_camera: FloatArray, stamps: FloatArray) -> FloatArray:
        """Positions of the camera ``(M, 3)`` at the fixes, from its poses ``(N, 4, 4)`` at ``stamps`` ``(N,)``."""
        return np.column_stack([np.interp(self.stamps, stamps, T_any_camera[:, axis, 3]) for axis in range(3)])


def fixes_of(track: GpsTrack, stamps: FloatArray, config: GpsConfig) -> GpsFixes | Failed:
    """The fixes of a track between the first and the last of the frames' ``stamps`` ``(N,)``."""
    shifted = track.stamps + config.offset_s
    inside = (shifted >= stamps[0]) & (shifted <= stamps[-1])
    if inside.sum() < _LEAST_FIXES:
        return Failed(
            f"{int(inside.sum())} GPS fixes lie between the first and the last frame: the track has stamps from "
            f"{shifted[0]:.1f} to {shifted[-1]:.1f} s, the frames from {stamps[0]:.1f} to {stamps[-1]:.1f} s: set "
            "gps.offset_s, or give the track of this drive"
        )
    times, dilution = shifted[inside], track.dilution[inside]
    frame = LocalFrame(track.places[inside][0])
    sigmas = np.array([config.sigma_m, config.sigma_m, config.vertical_sigma_m]) * dilution[:, None]
    widening = float(np.sqrt(max(config.correlation_s / float(np.median(np.diff(times))), 1.0)))
    points = frame.points(track.places[inside])
    return GpsFixes(times, points, sigmas, widening, frame)


def scale_by_gps(fixes: GpsFixes, T_world_camera_unscaled: FloatArray, stamps: FloatArray) -> ScaleEstimate | Failed:
    """The ratio of chords by GPS to chords of the estimate: the median, so that drift and outliers count little.

    Errors of fixes lengthen a chord by about their variance over its length. So chords are a tenth of the fixes, or
    several of them where these span less than 20 sigmas, and are chosen by the camera's lengths: choosing by GPS would
    prefer chords that errors lengthen.
    """
    estimated = fixes.camera(T_world_camera_unscaled, stamps)
    sigma = float(np.median(fixes.sigmas[:, 0]))
    least = _LEAST_MOTION_SIGMAS * sigma

    def chords(span: int) -> tuple[FloatArray, FloatArray]:
        by_gps, by_camera = (np.linalg.norm(p[span:] - p[:-span], axis=1) for p in (fixes.points, estimated))
        return by_gps, by_camera

    tenth = max(len(estimated) // _CHORDS, 1)
    spans = range(tenth, max(len(estimated) // 2, tenth) + 1, tenth)
    longest = max(spans, key=lambda span: float(np.median(chords(span)[1])))
    by_gps, by_camera = chords(longest)
    metres = by_gps.sum() / max(by_camera.sum(), np.finfo(float).tiny)
    lengths = metres * chords(tenth)[1]
    usable = lengths > least
    if usable.sum() < MIN_FRAMES:
        return Failed(
            f"the camera moves too little: {int(usable.sum())} stretches of a tenth of the fixes span over "
            f"{least:.1f} m, five sigmas, and move in the images; {MIN_FRAMES} are needed, and the longest spans "
            f"{lengths.max():.1f} m; gps.sigma_m may be smaller for a good receiver"
        )
    good = _GOOD_CHORD_SIGMAS * sigma
    by_gps, by_camera = chords(next((s for s in spans if metres * np.median(chords(s)[1]) >= good), longest))
    usable = metres * by_camera > least
    ratios = by_gps[usable] / by_camera[usable]
    value = float(np.median(ratios))
    return ScaleEstimate(value, mad_sigma(np.log(ratios / value)), int(usable.sum()))


def align(fixes: GpsFixes, T_world_camera: FloatArray, stamps: FloatArray) -> FloatArray | Failed:
    """``T_enu_world`` ``(4, 4)`` by the fixes, robustly; about a straight path by the camera's own up."""
    camera = fixes.camera(T_world_camera, stamps)
    sigma = fixes.sigmas * fixes.widening
    extent = float(np.ptp(fixes.points[:, :2], axis=0).max())
    least = _LEAST_MOTION_SIGMAS * float(np.median(sigma[:, 0]))
    if extent < least:
        return Failed(
            f"the camera moves too little for GPS to tell its heading: {extent:.1f} m, and {least:.1f} m are needed "
            "with these gps.sigma_m and gps.correlation_s"
        )
    up_world = -T_world_camera[:, :3, 1].mean(axis=0)
    by_up = np.outer([0.0, 0.0, 1.0], up_world) / _UP_SIGMA**2
    precision = 1.0 / (sigma**2).mean(axis=1)
    weights = precision
    for _ in range(_ROUNDS):
        share = (weights / weights.sum())[:, None]
        mean_enu, mean_world = (share * fixes.points).sum(axis=0), (share * camera).sum(axis=0)
        spread = (fixes.points - mean_enu).T @ (weights[:, None] * (camera - mean_world))
        R_enu_world = se3.nearest_rotation(spread + by_up)
        T_enu_world = se3.make(R_enu_world, mean_enu - R_enu_world @ mean_world)
        whitened = np.linalg.norm((se3.apply(T_enu_world, camera) - fixes.points) / sigma, axis=1)
        weights = precision * np.minimum(1.0, _HUBER_K / np.maximum(whitened, 1e-9))
    return T_enu_world


def offsets(fixes: GpsFixes, T_enu_camera: FloatArray, stamps: FloatArray) -> FloatArray:
    """From the fixes to the path at their times ``(M, 3)``, east, north and up."""
    return fixes.camera(T_enu_camera, stamps) - fixes.points


def positions_at_frames(
    fixes: GpsFixes, T_enu_world: FloatArray, T_world_camera: FloatArray, stamps: FloatArray
) -> list[MeasuredPosition]:
    """Every fix at the frame nearest in time, moved there by the camera's own motion."""
    frames = nearest_stamps(fixes.stamps, stamps)
    T_enu_camera = T_enu_world @ T_world_camera
    moved = T_enu_camera[frames, :3, 3] - fixes.camera(T_enu_camera, stamps)
    rows = zip(frames.tolist(), fixes.points + moved, fixes.widening * fixes.sigmas, strict=True)
    return [MeasuredPosition(index, point, sigmas) for index, point, sigmas in rows]
