"""True poses of a recording at the stamps of its images: one file a frame, or a file of the user."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from erfsfm.common.files import read_text
from erfsfm.common.readers.frame_range import runs
from slam.formats.trajectory import nearest_stamps, other_unit, read_trajectory
from slam.geometry import se3
from slam.geometry.se3 import BoolArray, FloatArray
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

    ``ValueError``: the length of a quaternion is not 1, or a position is not finite or farther than 1e12.
    """
    if not (np.abs(positions) <= _FARTHEST).all():
        raise ValueError(f"a position is not finite, or farther than {_FARTHEST:g}")
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(quaternions_xyzw, axis=1)
    is_unit = np.abs(lengths - 1) <= _LENGTH_TOLERANCE
    if not is_unit.all():
        raise ValueError(f"a quaternion has length {lengths[~is_unit][0]:g}")
    return se3.make(Rotation.from_quat(quaternions_xyzw).as_matrix(), positions)


def poses_near(
    T_any_camera: FloatArray, known: FloatArray, stamps: FloatArray, path: Path
) -> FloatArray:
    """Interpolated poses ``(N, 4, 4)`` at stamps ``(N,)`` from ``(M, 4, 4)`` of ``path`` at known stamps ``(M,)``.

    The motion goes on at both ends. NaN, with a warning, where the nearest known pose is more than 0.1 s away; of poses
    as rare as images a missing one is bridged, up to 0.3 s.

    Args:
        T_any_camera: known poses ``(M, 4, 4)`` in any world.
        known: their stamps ``(M,)``, increasing, seconds.
        stamps: of the images ``(N,)``, seconds.
        path: where they were read, for the warning.
    """
    if np.array_equal(known, stamps):
        return T_any_camera
    T_near = np.full((len(stamps), 4, 4), np.nan)
    if len(known) > 1:
        reach_s = float(np.clip(_BRIDGED * np.median(np.diff(known)), *_REACH_S))
        first, last = np.searchsorted(
            known, (known[0] + reach_s, known[-1] - reach_s), side="right"
        ) - (0, 1)
        first, last = min(first, len(known) - 1), max(last, 0)
        before = T_any_camera[0] @ se3.invert(T_any_camera[first]) @ T_any_camera[0]
        after = T_any_camera[-1] @ se3.invert(T_any_camera[last]) @ T_any_camera[-1]
        reached = np.r_[2 * known[0] - known[first], known, 2 * known[-1] - known[last]]
        T_near = se3.interpolate(
            np.concatenate([before[None], T_any_camera, after[None]]), reached, stamps
        )
        T_near[np.abs(known[nearest_stamps(stamps, known)] - stamps) > reach_s] = np.nan
    are_known = known_poses(T_near)
    if not are_known.all():
        longest = max(
            runs(np.flatnonzero(are_known).tolist()), key=lambda run: run[1] - run[0], default=None
        )
        advice = (
            ""
            if longest is None
            else f"; frames {longest[0]}:{longest[1] + 1} have one each (--frames)"
        )
        missing = int(np.argmin(are_known))
        logger.warning(
            "%s has no pose of image %d: the sequence has no reference%s", path, missing, advice
        )
    return T_near


def known_poses(T_any_camera: FloatArray) -> BoolArray:
    """Which of the poses ``(N, 4, 4)`` are known."""
    return np.asarray(np.isfinite(T_any_camera).all(axis=(1, 2)))


def read_matrix(path: Path, what: str) -> FloatArray:
    """A file of 4 x 4 numbers, which describe what it says.

    Args:
        path: of the file.
        what: the numbers describe, for the message.

    Raises:
        SequenceError: the file cannot be read, or does not hold 16 numbers.
    """
    try:
        return np.array(read_text(path).split(), dtype=np.float64).reshape(4, 4)
    except (OSError, ValueError) as error:
        raise SequenceError(f"{path} must hold the 4 x 4 numbers of {what}: {error}") from error


def pose_files(paths: list[Path], stamps: FloatArray) -> FloatArray | None:
    """`poses_near` of files of 4 x 4 numbers, one an image, some of which may be missing; None where all are.

    Numbers that are not finite are those of a camera that lost track.

    Args:
        paths: a file an image.
        stamps: of the images ``(N,)``, seconds.

    Raises:
        SequenceError: a file does not hold 16 numbers, or no pose.
    """
    if not any(path.exists() for path in paths):
        return None
    poses = np.full((len(paths), 4, 4), np.nan)
    for k, path in enumerate(paths):
        if path.exists():
            poses[k] = read_matrix(path, "a pose")
            if np.isfinite(poses[k]).all() and not se3.is_se3(poses[k], _ROTATION_TOLERANCE):
                raise SequenceError(f"{path} holds no pose: its 3 x 3 part is not a rotation")
    known = known_poses(poses)
    return poses_near(se3.rigid(poses[known]), stamps[known], stamps, paths[0].parent)


def read_truth(path: Path, stamps: FloatArray) -> FloatArray:
    """The true poses ``T_any_camera`` ``(N, 4, 4)`` of images at stamps ``(N,)`` in a file of trajectories, metres.

    Rows with stamps belong to the frames of these times, rows with frame numbers to these frames, and others to the
    frames one by one; NaN where unknown.

    Raises:
        SequenceError: its rows are not as many as frames, or it covers none of them.
        TrajectoryError: the file cannot be read as a trajectory.
    """
    truth, frames = read_trajectory(path), len(stamps)
    numbers = truth.frame_numbers
    if truth.timed:
        T_any_camera = poses_near(truth.T_world_camera, truth.stamps, stamps, path)
    elif truth.numbered or truth.frame_count == frames:
        of_frame = (numbers >= 0) & (numbers < frames)
        known = stamps[numbers[of_frame]]
        T_any_camera = poses_near(truth.T_world_camera[of_frame], known, stamps, path)
    else:
        raise SequenceError(
            f"--truth {path} has {truth.frame_count} rows and the recording {frames} frames: give each frame a row, "
            "or rows with stamps (TUM)"
        )
    cure = other_unit(truth.stamps, stamps) if truth.timed else None
    if cure or not known_poses(T_any_camera).any():
        its, ours = (f"{numbers[0]:.3f} to {numbers[-1]:.3f}" for numbers in (truth.stamps, stamps))
        raise SequenceError(
            f"--truth {path} covers {its} and the recording {ours}: {cure or 'bring both to the same clock'}"
        )
    return T_any_camera


def poses_beside(recording: Path) -> Path | None:
    """A file ``poses*.txt`` in or beside a recording; nothing tells whose poses they are."""
    place = recording.absolute()
    found = [*sorted(place.glob("poses*.txt")), *sorted(place.parent.glob("poses*.txt"))]
    return next(iter(found), None)
