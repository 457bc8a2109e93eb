"""How a camera turned since a keyframe, from corners with or without points, where its parallax is too small for them.

As panorama keyframes (Pirchheim et al. 2013): a turn on the spot gives no points, but its rotation is exact.
"""

from __future__ import annotations

import numpy as np

from slam.frames import KEYFRAME_SOURCE, Intrinsics, RelativePose
from slam.frontend.keyframes.camera_pose import MIN_POINTS
from slam.frontend.keyframes.local_map import TrackedKeyframe, TrackIds
from slam.frontend.sparse_flow import Pixels
from slam.frontend.visual.epipolar import parallax_px, rotation_between
from slam.geometry.se3 import FloatArray, make

_LEAST_PARALLAX_RATIO = 0.0125  # median parallax from which on two views give points, over the image width
_IMAGE_SIGMA, _IMAGE_LENGTH = np.deg2rad(0.5), 0.03
_ROTATION_SIGMA, _LENGTH_SIGMA = np.deg2rad(0.1), 0.01  # least sigmas, radians and depths


def rotation_and_parallax(
    rays_before: FloatArray, rays: FloatArray, intrinsics: Intrinsics
) -> tuple[FloatArray, float]:
    """``R_now_before`` of matched rays ``(M, 3)``, z = 1, and the median parallax that it leaves, pixels."""
    R = rotation_between(rays_before, rays)
    return R, float(np.median(parallax_px(rays_before, rays, R, intrinsics)))


def is_turn(parallax: float, intrinsics: Intrinsics) -> bool:
    """Whether a median parallax, in pixels, is too small for points."""
    return parallax < _LEAST_PARALLAX_RATIO * intrinsics.width


def turn_since(
    keyframe: TrackedKeyframe, index: int, track_ids: TrackIds, pixels: Pixels, intrinsics: Intrinsics
) -> RelativePose | None:
    """From a keyframe to the frame of this index, with sigmas of lengths in depths; None where it did not just turn.

    Args:
        keyframe: the one that is tracked.
        index: of the frame.
        track_ids: of the keyframe's corners that the frame sees ``(M,)``.
        pixels: where it sees them ``(M, 2)``, when its middle row was read.
        intrinsics: of both.
    """
    if len(track_ids) < MIN_POINTS:
        return None
    before = keyframe.pixels[np.searchsorted(keyframe.track_ids, track_ids)]
    rays_before, rays = intrinsics.rays(before), intrinsics.rays(pixels.astype(np.float64))
    R, parallax = rotation_and_parallax(rays_before, rays, intrinsics)
    if not is_turn(parallax, intrinsics):
        return None
    angle = parallax / intrinsics.fx
    sigmas = np.repeat([np.hypot(_ROTATION_SIGMA, angle), _LENGTH_SIGMA + 2.0 * angle], 3)
    return RelativePose(keyframe.index, index, make(R.T, np.zeros(3)), sigmas, KEYFRAME_SOURCE)


def turn_by_image(first: int, last: int, R_last_first: FloatArray) -> RelativePose:
    """Between two frames whose whole images show a turn."""
    sigmas = np.repeat([_IMAGE_SIGMA, _IMAGE_LENGTH], 3)
    return RelativePose(first, last, make(R_last_first.T, np.zeros(3)), sigmas, KEYFRAME_SOURCE)
