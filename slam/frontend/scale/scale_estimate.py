"""The scale of learned depth: from ground planes at a known camera height, or from a reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.config.sections import ScaleConfig, ScaleMode
from slam.frontend.scale.road_plane import GroundPlane
from slam.geometry.robust import mad_sigma, running_median
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import Failed, SlamError

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
