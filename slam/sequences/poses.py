"""True poses at the stamps of images, and as one file a frame."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from erfsfm.common.files import read_text
from slam.frames import runs
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError

logger = logging.getLogger(__name__)

_REACH_S, _BRIDGED = (0.1, 0.3), 1.5  # bounds, and in periods of the poses
_FARTHEST = 1e12
_LENGTH_TOLERANCE = 0.1  # of quaternions, which are written with few digits
_ROTATION_TOLERANCE = 0.01  # 7-Scenes writes seven digits, ScanNet six


def rebased(T_any_camera: FloatArray) -> FloatArray:
    """Poses ``T_world_camera`` ``(N, 4, 4)`` whose world is the first camera; the first is the identity."""
    T_any_first = T_any_camera[0].copy()
    T_any_first[:3, :3] = se3.nearest_rotation(T_any_first[:3, :3])
    T_world_camera: FloatArray = se3.invert(T_any_first) @ T_any_camera
    T_world_camera[0] = np.eye(4)
    return T_world_camera


def poses_of(positions: FloatArray, quaternions_xyzw: FloatArray) -> FloatArray:
    """Poses ``(N, 4, 4)`` of positions ``(N, 3)`` and quaternions ``(N, 4)``, which are normalised.

    Raises:
        ValueError: the length of a quaternion is not 1, or a position is not finite or farther than 1e12.
    """
    if not (np.abs(positions) <= _FARTHEST).all():
        raise ValueError(f"a position is not finite, or farther than {_FARTHEST:g}")
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(quaternions_xyzw, axis=1)
    if not (np.abs(lengths - 1) <= _LENGTH_TOLERANCE).all():
        raise ValueError(f"a quaternion has length {lengths[np.argmax(~(np.abs(lengths - 1) <= _LENGTH_TOLERANCE))]:g}")
    return se3.make(Rotation.from_quat(quaternions_xyzw).as_matrix(), positions)


def poses_near(T_any_camera: FloatArray, known: FloatArray, stamps: FloatArray, path: Path) -> FloatArray:
    """Interpolated poses ``(N, 4, 4)`` at stamps ``(N,)`` from poses ``(M, 4, 4)`` at increasing stamps ``(M,)``.

    The motion goes on at both ends. NaN, with a warning, where the nearest known pose is more than 0.1 s away; of poses
    as rare as images a missing one is bridged, up to 0.3 s.

    Args:
        T_any_camera: what is known, from ``path``.
        known: its stamps in seconds.
        stamps: those of the images.
        path: for the warning.
    """
    T_near = np.full((len(stamps), 4, 4), np.nan)
    if len(known) > 1:
        reach_s = float(np.clip(_BRIDGED * np.median(np.diff(known)), *_REACH_S))
        first, last = np.searchsorted(known, (known[0] + reach_s, known[-1] - reach_s), side="right") - (0, 1)
        first, last = min(first, len(known) - 1), max(last, 0)
        before = T_any_camera[0] @ se3.invert(T_any_camera[first]) @ T_any_camera[0]
        after = T_any_camera[-1] @ se3.invert(T_any_camera[last]) @ T_any_camera[-1]
        reached = np.r_[2 * known[0] - known[first], known, 2 * known[-1] - known[last]]
        T_near = se3.interpolate(np.concatenate([before[None], T_any_camera, after[None]]), reached, stamps)
        place = np.clip(np.searchsorted(known, stamps, side="right") - 1, 0, len(known) - 2)
        gap = np.minimum(np.abs(stamps - known[place]), np.abs(known[place + 1] - stamps))
        T_near[gap > reach_s] = np.nan
    describe_unknown(T_near, path)
    return T_near


def describe_unknown(T_any_camera: FloatArray, path: Path) -> None:
    """Warn of frames without a true pose, and say which have one.

    Args:
        T_any_camera: ``(N, 4, 4)``, NaN where unknown.
        path: the file of true poses.
    """
    known = known_poses(T_any_camera)
    if known.all():
        return
    longest = max(runs(np.flatnonzero(known).tolist()), key=lambda run: run[1] - run[0], default=None)
    advice = "" if longest is None else f"; frames {longest[0]}:{longest[1] + 1} have one each (--frames)"
    missing = int(np.argmin(known))
    logger.warning("%s has no pose of image %d: the sequence has no reference%s", path, missing, advice)


def known_poses(T_any_camera: FloatArray) -> NDArray[np.bool_]:
    """Which of the poses ``(N, 4, 4)`` are known."""
    return np.asarray(np.isfinite(T_any_camera).all(axis=(1, 2)))


def read_pose_files(paths: list[Path]) -> FloatArray:
    """``T_any_camera`` ``(N, 4, 4)`` of files, NaN where one is missing or its numbers are not finite (tracking lost).

    Raises:
        SequenceError: a file holds other than 16 numbers, or no pose.
    """
    T_any_camera = np.full((len(paths), 4, 4), np.nan)
    for k, path in enumerate(paths):
        if not path.exists():
            continue
        try:
            pose = np.array(read_text(path).split(), dtype=np.float64).reshape(4, 4)
        except (OSError, ValueError) as error:
            raise SequenceError(f"{path} must hold the 4 x 4 numbers of a pose: {error}") from error
        if not np.isfinite(pose).all():
            continue
        if not se3.is_se3(pose, _ROTATION_TOLERANCE):
            raise SequenceError(f"{path} holds no pose: its 3 x 3 part is not a rotation")
        pose[:3, :3] = se3.nearest_rotation(pose[:3, :3])
        T_any_camera[k] = pose
    return T_any_camera
