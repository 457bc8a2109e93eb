"""How a camera moved since a keyframe where it has no points: by learned depth, or its turn where it has no parallax.

As panorama keyframes (Pirchheim et al. 2013): a turn on the spot gives no points, but its rotation is exact.
"""

from __future__ import annotations

import numpy as np

from slam.frames import KEYFRAME_SOURCE, Intrinsics, RelativePose
from slam.frontend.keyframes.camera_pose import INLIER_PX, MIN_POINTS, resect
from slam.frontend.keyframes.local_map import TrackedKeyframe, TrackIds
from slam.frontend.sparse_flow import Pixels
from slam.frontend.visual.epipolar import parallax_px, rotation_between
from slam.geometry.se3 import FloatArray, invert, make

_LEAST_PARALLAX_RATIO = 0.0125  # median parallax from which on two views give points, over the image width
_IMAGE_SIGMA, _IMAGE_LENGTH = np.deg2rad(0.5), 0.03
_ROTATION_SIGMA, _LENGTH_SIGMA = np.deg2rad(0.1), 0.01  # least sigmas, radians and depths
_DEPTH_SIGMA = 0.2  # of a length by learned depth, over it
_LEAST_FITTING = 0.7  # ratio of corners that fit a motion by learned depth


def rotation_and_parallax(
    rays_before: FloatArray, rays: FloatArray, intrinsics: Intrinsics
) -> tuple[FloatArray, float]:
    """``R_now_before`` of matched rays ``(M, 3)``, z = 1, and the median parallax that it leaves, pixels."""
    R = rotation_between(rays_before, rays)
    return R, float(np.median(parallax_px(rays_before, rays, R, intrinsics)))


def is_turn(parallax: float, intrinsics: Intrinsics) -> bool:
    """Whether a median parallax, in pixels, is too small for points."""
    return parallax < _LEAST_PARALLAX_RATIO * intrinsics.width


def motion_since(
    keyframe: TrackedKeyframe,
    index: int,
    track_ids: TrackIds,
    pixels: Pixels,
    depth: float,
    intrinsics: Intrinsics,
    seed: int = 0,
) -> RelativePose | None:
    """From a keyframe to the frame of this index, lengths in the unit of learned depth; None where that is not known.

    By learned depth of the corners where most of them fit one motion, else a turn if there is hardly any parallax.

    Args:
        keyframe: the one that is tracked.
        index: of the frame.
        track_ids: of the keyframe's corners that the frame sees ``(M,)``.
        pixels: where it sees them ``(M, 2)``, when its middle row was read.
        depth: usual learned depth, for a keyframe that has none.
        intrinsics: of both.
        seed: of RANSAC.
    """
    if len(track_ids) < MIN_POINTS:
        return None
    rows = np.searchsorted(keyframe.track_ids, track_ids)
    rays_before, rays = intrinsics.rays(keyframe.pixels[rows]), intrinsics.rays(pixels.astype(np.float64))
    R, parallax = rotation_and_parallax(rays_before, rays, intrinsics)
    learned = keyframe.learned_depth[rows]
    known = np.isfinite(learned)
    if known.sum() >= MIN_POINTS:
        depth = float(np.median(learned[known]))
        points = rays_before[known] * learned[known, None]
        pose = resect([make(R, np.zeros(3))], points, pixels[known].astype(np.float64), intrinsics, seed)
        if (pose.residual_px < INLIER_PX).mean() > _LEAST_FITTING:
            T = invert(pose.T_camera_world)
            length = _LENGTH_SIGMA * depth + _DEPTH_SIGMA * float(np.linalg.norm(T[:3, 3]))
            floors = np.repeat([_ROTATION_SIGMA, length], 3)
            return RelativePose(keyframe.index, index, T, np.hypot(pose.sigmas, floors), KEYFRAME_SOURCE)
    if not is_turn(parallax, intrinsics):
        return None
    angle = parallax / intrinsics.fx
    sigmas = np.repeat([np.hypot(_ROTATION_SIGMA, angle), depth * (_LENGTH_SIGMA + 2.0 * angle)], 3)
    return RelativePose(keyframe.index, index, make(R.T, np.zeros(3)), sigmas, KEYFRAME_SOURCE)


def turn_by_image(first: int, last: int, R_last_first: FloatArray, depth: float) -> RelativePose:
    """Between two frames whose whole images show a turn, at a usual ``depth``."""
    sigmas = np.repeat([_IMAGE_SIGMA, _IMAGE_LENGTH * depth], 3)
    return RelativePose(first, last, make(R_last_first.T, np.zeros(3)), sigmas, KEYFRAME_SOURCE)
