"""LiDAR odometry on the scans of the frames: kiss-icp (Vizzo et al. 2023)."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from erfsfm.common.errors import ErfsfmError
from erfsfm.common.progress import Progress, silent
from slam.frames import RelativePose, Sequence
from slam.geometry.se3 import FloatArray, IntArray, invert
from slam.runtime.errors import Failed, SlamError

logger = logging.getLogger(__name__)

LEAST_SCANS = 2
LIDAR_SOURCE = "lidar"
_ROTATION_SIGMA_DEG = 0.1  # rotation sigma of a step, degrees
_TRANSLATION_SIGMA_M = 0.03  # translation sigma of a step, metres


@dataclass(frozen=True)
class LidarPath:
    """``frames`` ``(S,)`` that have a scan, and ``T_world_camera`` ``(S, 4, 4)`` there, metres, first the identity.

    ``unreadable`` says of frames why their scan could not be read; they are left out.
    """

    frames: IntArray
    T_world_camera: FloatArray
    unreadable: Mapping[int, str] = field(default_factory=dict)


def has_scans(sequence: Sequence) -> bool:
    """Whether two neighbouring frames have a scan each and the LiDAR's extrinsics are known."""
    scanned = [sequence.has_scan(k) for k in range(len(sequence))]
    return sequence.T_camera_lidar is not None and any(map(all, itertools.pairwise(scanned)))


def readable_scan(sequence: Sequence, frame: int) -> FloatArray | str:
    """The points ``(P, 3)`` of a frame's scan, metres, in the LiDAR, or why they cannot be read."""
    try:
        return sequence.scan(frame)
    except (SlamError, ErfsfmError) as error:
        return str(error)


def lidar_path(sequence: Sequence, progress: Progress = silent) -> LidarPath | Failed | None:
    """Register the scans of a sequence one after the other; None where it has fewer than two.

    Scans that cannot be read are left out, with one warning; a failure, without one, where fewer
    than two can.
    """
    scanned = [k for k in range(len(sequence)) if sequence.has_scan(k)]
    T_camera_lidar = sequence.T_camera_lidar
    if len(scanned) < LEAST_SCANS or T_camera_lidar is None:
        return None
    # kiss-icp takes a while to import and most sequences have no scans
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP

    settings = load_config(None)
    settings.data.deskew = False  # the points have no time stamps
    settings.registration.max_num_threads = 1  # reproducible
    odometry = KissICP(settings)
    frames, T_first_lidar, unreadable = [], [], {}
    for done, frame in enumerate(scanned):
        progress("lidar scans", done, len(scanned))
        points = readable_scan(sequence, frame)
        if isinstance(points, str):
            unreadable[frame] = points
            continue
        odometry.register_frame(points, np.array([]))
        frames.append(frame)
        T_first_lidar.append(odometry.last_pose.copy())
    if unreadable:
        found = f"{len(unreadable)} of {len(scanned)} LiDAR scans cannot be read, first {min(unreadable.items())[1]}"
        if len(frames) < LEAST_SCANS:
            return Failed(found)
        logger.warning("%s: they are left out", found)
    T_world_camera = T_camera_lidar @ np.stack(T_first_lidar) @ invert(T_camera_lidar)
    logger.info("kiss-icp registered %d scans", len(frames))
    return LidarPath(
        np.array(frames, dtype=np.int64), invert(T_world_camera[0]) @ T_world_camera, unreadable
    )


def lidar_steps(path: LidarPath) -> list[RelativePose]:
    """Relative poses of neighbouring frames that both have a scan."""
    sigmas = np.repeat([np.deg2rad(_ROTATION_SIGMA_DEG), _TRANSLATION_SIGMA_M], 3)
    T_previous_current = invert(path.T_world_camera[:-1]) @ path.T_world_camera[1:]
    return [
        RelativePose(first, second, T, sigmas, LIDAR_SOURCE)
        for (first, second), T in zip(
            itertools.pairwise(path.frames.tolist()), T_previous_current, strict=True
        )
        if second == first + 1
    ]


def usable_steps(path: LidarPath | Failed | None, are_needed: bool) -> list[RelativePose]:
    """The steps of a path, with a warning where it failed.

    Raises:
        SlamError: there are none, and they ``are_needed`` for all lengths.
    """
    steps = lidar_steps(path) if isinstance(path, LidarPath) else []
    reason = path.reason if isinstance(path, Failed) else "no two neighbouring scans can be read"
    if are_needed and not steps:
        raise SlamError(
            f"scale.mode=lidar: {reason}: leave the setting out, or give a sequence with scans"
        )
    if isinstance(path, Failed):
        logger.warning("%s: the run goes on without LiDAR", reason)
    return steps
