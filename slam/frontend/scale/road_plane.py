"""The unit of learned depth: from the road below the camera, or from a reference.

The road plane is fitted to the learned depth of every frame. With the plane
``n . X = h`` and a pixel's ray ``r`` (z = 1), ``1 / z = (n / h) . r``: inverse depth is linear in the
ray, and the ray is free of noise, so the fit is not biased by the depth's errors as a fit of points is.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.config import ScaleConfig, ScaleMode
from slam.frames import DepthMap, Intrinsics, RelativePose
from slam.frontend.failure import MeasurementFailure
from slam.robust import mad_sigma
from slam.se3 import FloatArray

_POINTS = 1500
_HYPOTHESES = 150
_REWEIGHTINGS = 8


@dataclass(frozen=True)
class GroundPlane:
    """The road under one camera: distance, unit normal ``(3,)`` down to it, share of inliers in [0, 1]."""

    height_unscaled: float
    normal: FloatArray
    inlier_ratio: float


@dataclass(frozen=True)
class ScaleEstimate:
    """``value`` times an unscaled length is a length in the mode's unit.

    ``spread`` is the relative sigma of the single frames' values.
    """

    value: float
    spread: float
    frames_used: int


def resolve_mode(config: ScaleConfig, camera_height_m: float | None) -> ScaleMode:
    """The mode that ``auto`` stands for: camera-height where the height is known, else none."""
    if config.mode != "auto":
        return config.mode
    return "none" if camera_height_m is None else "camera-height"


def fit_ground_plane(
    depth_unscaled: DepthMap, intrinsics: Intrinsics, config: ScaleConfig
) -> GroundPlane | MeasurementFailure:
    """Fit the road in a trapezoid before the car, by RANSAC and reweighted least squares on inverse depth.

    Args:
        depth_unscaled: learned z-depth ``(H, W)`` at the size of ``intrinsics``.
        intrinsics: the camera, pixels.
        config: trapezoid, tolerances and the largest tilt.
    """
    rows, columns, all_rays = _trapezoid(intrinsics, config)
    inverse_depth = 1.0 / np.maximum(depth_unscaled[rows, columns].astype(np.float64), 1e-9)
    usable = np.isfinite(inverse_depth) & (inverse_depth < 1e8)
    if usable.sum() < 50:
        return MeasurementFailure("the depth before the car is not usable")
    rays = all_rays[usable]  # (P, 3)
    inverse_depth = inverse_depth[usable]
    scaled_normal = _ransac(rays, inverse_depth, config)
    if scaled_normal is None:
        return MeasurementFailure(f"no plane within {config.max_tilt_deg:g} deg of level before the car")
    scaled_normal = _reweighted(rays, inverse_depth, scaled_normal, config.inlier_relative_depth)
    height = 1.0 / float(np.linalg.norm(scaled_normal))
    normal = scaled_normal * height
    inlier_ratio = float(_inliers(rays, inverse_depth, scaled_normal[None], config)[0].mean())
    if normal[1] < np.cos(np.deg2rad(config.max_tilt_deg)):
        return MeasurementFailure(f"the plane before the car is tilted by more than {config.max_tilt_deg:g} deg")
    if inlier_ratio < config.min_inlier_ratio:
        return MeasurementFailure(f"only {inlier_ratio:.0%} of the pixels before the car lie on one plane")
    return GroundPlane(height, normal, inlier_ratio)


def scale_from_road(
    roads: Sequence[GroundPlane | MeasurementFailure], camera_height_m: float | None, config: ScaleConfig
) -> ScaleEstimate | MeasurementFailure:
    """Metres per unscaled length; without a known height, camera heights per unscaled length (mode none)."""
    height = 1.0 if camera_height_m is None else camera_height_m
    ratios = [height / road.height_unscaled for road in roads if isinstance(road, GroundPlane)]
    return estimate_scale(np.array(ratios), config)


def scale_from_reference(
    T_world_camera_unscaled: FloatArray, T_world_camera_true: FloatArray, config: ScaleConfig
) -> ScaleEstimate | MeasurementFailure:
    """True path length over estimated path length of the first ``reference_frames`` frames."""
    estimated, true = (
        np.linalg.norm(np.diff(T[: config.reference_frames, :3, 3], axis=0), axis=1)
        for T in (T_world_camera_unscaled, T_world_camera_true)
    )
    if estimated.sum() <= 0 or true.sum() <= 0:
        return MeasurementFailure(f"the camera does not move within the first {config.reference_frames} frames")
    value = float(true.sum() / estimated.sum())
    moving = estimated > 0.1 * estimated.mean()
    spread = float(np.std(true[moving] / estimated[moving] / value))
    return ScaleEstimate(value, spread, len(estimated) + 1)


def estimate_scale(ratios: FloatArray, config: ScaleConfig) -> ScaleEstimate | MeasurementFailure:
    """One scale from a ratio per frame ``(K,)``: their median, frames many MADs away left out."""
    ratios = np.asarray(ratios, dtype=np.float64)
    ratios = ratios[np.isfinite(ratios) & (ratios > 0)]
    if len(ratios) < config.min_frames:
        return MeasurementFailure(f"only {len(ratios)} frames measure the scale, {config.min_frames} are needed")
    logarithms = np.log(ratios)
    deviations = np.abs(logarithms - np.median(logarithms))
    kept = logarithms[deviations <= config.rejection_mads * mad_sigma(deviations) + 1e-12]
    spread = mad_sigma(kept - np.median(kept))
    return ScaleEstimate(float(np.exp(np.median(kept))), spread, len(kept))


def scale_track(
    roads: Sequence[GroundPlane | MeasurementFailure],
    camera_height_m: float | None,
    estimate: ScaleEstimate,
    config: ScaleConfig,
) -> FloatArray:
    """The scale near each frame ``(N,)``: a running median of the road's ratios.

    Learned depth breathes: its unit wanders along a drive. Where ``smoothing_frames`` around a frame hold
    too few usable roads, the estimate of the whole drive stands in.
    """
    height = 1.0 if camera_height_m is None else camera_height_m
    ratios = np.array([height / r.height_unscaled if isinstance(r, GroundPlane) else np.nan for r in roads])
    bound = config.rejection_mads * max(estimate.spread, 0.02)
    ratios[np.abs(np.log(ratios / estimate.value)) > bound] = np.nan
    half = config.smoothing_frames // 2
    track = np.full(len(ratios), estimate.value)
    for k in range(len(ratios)):
        near = ratios[max(k - half, 0) : k + half + 1]
        if np.isfinite(near).sum() >= config.min_frames:
            track[k] = np.nanmedian(near)
    return track


def rescaled(relative_pose: RelativePose, scale: float) -> RelativePose:
    """A measurement in other units: translation and its sigmas times ``scale``."""
    T_from_to = relative_pose.T_from_to.copy()
    T_from_to[:3, 3] *= scale
    units = np.repeat([1.0, scale], 3)
    correlated_sigmas = None if relative_pose.correlated_sigmas is None else relative_pose.correlated_sigmas * units
    return replace(
        relative_pose, T_from_to=T_from_to, sigmas=relative_pose.sigmas * units, correlated_sigmas=correlated_sigmas
    )


@functools.lru_cache(maxsize=4)
def _trapezoid(intrinsics: Intrinsics, config: ScaleConfig) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Rows, columns ``(P,)`` and rays ``(P, 3)`` of about ``_POINTS`` pixels.

    The horizon is taken at cy (a level camera).
    """
    horizon, bottom = intrinsics.cy, intrinsics.height - 1.0
    shares = (config.road_top_ratio, config.road_bottom_ratio)
    top_row, bottom_row = (horizon + share * (bottom - horizon) for share in shares)
    area = intrinsics.width * (bottom_row - top_row) * (config.road_top_width + config.road_bottom_width) / 2
    step = max(1.0, float(np.sqrt(max(area, 1.0) / _POINTS)))
    rows_seen = np.unique(np.clip(np.arange(top_row, bottom_row, step), 0, bottom).astype(np.int64))
    rows, columns = [], []
    for row in rows_seen:
        share = (row - top_row) / (bottom_row - top_row)
        width = config.road_top_width + share * (config.road_bottom_width - config.road_top_width)
        half = width * intrinsics.width / 2
        across = np.arange(intrinsics.cx - half, intrinsics.cx + half, step)
        across = np.unique(across[(across >= 0) & (across < intrinsics.width)].astype(np.int64))
        columns.append(across)
        rows.append(np.full(len(across), row))
    empty = [np.empty(0, dtype=np.int64)]
    v, u = np.concatenate(rows or empty), np.concatenate(columns or empty)
    return v, u, intrinsics.rays(np.stack([u, v], axis=-1))


def _ransac(rays: FloatArray, inverse_depth: FloatArray, config: ScaleConfig) -> FloatArray | None:
    """``n / h`` ``(3,)`` of the level plane with most inliers, or None."""
    rng = np.random.default_rng(0)
    samples = rng.integers(len(rays), size=(_HYPOTHESES, 3))
    minimal = rays[samples]  # (S, 3, 3)
    solvable = np.abs(np.linalg.det(minimal)) > 1e-6
    if not solvable.any():
        return None
    planes = np.linalg.solve(minimal[solvable], inverse_depth[samples[solvable]][..., None])[..., 0]  # (S, 3)
    level = planes[:, 1] > np.cos(np.deg2rad(config.max_tilt_deg)) * np.linalg.norm(planes, axis=1)
    if not level.any():
        return None
    planes = planes[level]
    votes = _inliers(rays, inverse_depth, planes, config).sum(axis=1)
    best: FloatArray = planes[votes.argmax()]
    return best


def _inliers(rays: FloatArray, inverse_depth: FloatArray, planes: FloatArray, config: ScaleConfig) -> NDArray[np.bool_]:
    """Inliers ``(S, P)`` of planes ``n / h`` ``(S, 3)`` by the relative error of depth."""
    over_measured = (rays / inverse_depth[:, None]).T.astype(np.float32)
    relative = planes.astype(np.float32) @ over_measured
    relative -= 1.0
    return np.asarray(np.abs(relative, out=relative) < config.inlier_relative_depth)


def _reweighted(rays: FloatArray, inverse_depth: FloatArray, plane: FloatArray, sigma: float) -> FloatArray:
    """Refine ``n / h`` by least squares with Cauchy weights on the relative error of inverse depth."""
    for _ in range(_REWEIGHTINGS):
        predicted = np.maximum(rays @ plane, 1e-9)
        residual = inverse_depth / predicted - 1.0
        weights = 1.0 / (predicted**2 * (1.0 + (residual / (0.5 * sigma)) ** 2))
        weighted = rays * weights[:, None]
        plane = np.linalg.solve(weighted.T @ rays, weighted.T @ inverse_depth)
    return plane
