"""The unit of a run: what each scale mode needs, and the metres that it knows.

The one place that asks which mode is configured. A mode knows the camera's height before lengths are
solved, or metres per unit of an odometry after that.
"""

from __future__ import annotations

from functools import partial

import numpy as np

import slam.frames
from slam.config.sections import ScaleConfig, ScaleMode
from slam.frames import Ends
from slam.frontend.gps import GpsFixes
from slam.frontend.lidar_odometry import has_scans
from slam.frontend.scale import ScaleEstimate, Unit
from slam.geometry.se3 import FloatArray, length_of, path_distance
from slam.runtime.errors import Failed, SlamError

_REFERENCE_FRAMES = 50  # number of first frames that mode reference compares


def unit_of(
    config: ScaleConfig, sequence: slam.frames.Sequence, fixes: GpsFixes | None = None
) -> Unit:
    """The unit by the configured mode; ``auto`` is camera-height where a height is known, else gps, else none.

    Args:
        config: names the mode.
        sequence: to run on.
        fixes: those of a GPS track, where one was given.

    Raises:
        SlamError: the sequence lacks what the mode needs.
    """
    mode, height_m, true_poses = config.mode, sequence.camera_height_m, sequence.reference
    if mode == "auto":
        by_gps: ScaleMode = "none" if fixes is None else "gps"
        mode = by_gps if height_m is None else "camera-height"
    needs = f"scale mode {mode} needs"
    if mode == "camera-height":
        if height_m is None:
            raise SlamError(
                f"{needs} a known height; {sequence.name} has none: give a camera.yaml "
                "with camera_height_m (fov=DEGREES has none) or choose scale.mode=none"
            )
        return Unit(mode, height_m)
    if mode == "lidar":
        require_scans("scale.mode=lidar", sequence)
        return Unit(mode, height_m)
    if mode == "reference":
        if true_poses is None:
            raise SlamError(
                f"{needs} true poses; {sequence.name} has none: choose another scale.mode"
            )
        return Unit(mode, metres=partial(scale_from_reference, true_poses))
    if mode == "gps":
        if fixes is None:
            raise SlamError(f"{needs} a GPS track: give --gps FILE or choose another scale.mode")
        return Unit(mode, metres=fixes.scale)
    if mode == "known":
        if not len(sequence):
            raise SlamError(
                f"{needs} frames of a whole sequence, and {sequence.name} grows: choose another scale.mode"
            )
        ends = known_frames(config, sequence.stamps)
        return Unit(mode, metres=partial(scale_from_distance, ends, config.known_m or 0.0))
    return Unit(mode)


def require_scans(setting: str, sequence: slam.frames.Sequence) -> None:
    """Check that a sequence has the LiDAR that a setting needs.

    Raises:
        SlamError: it has none.
    """
    if not has_scans(sequence):
        raise SlamError(
            f"{setting} needs LiDAR scans of neighbouring frames and their calibration; {sequence.name} has none: "
            "leave the setting out or give a sequence with scans"
        )


def scale_from_reference(
    T_world_camera_true: FloatArray, T_world_camera_unscaled: FloatArray
) -> ScaleEstimate | Failed:
    """True path length over estimated path length of the first 50 frames."""
    estimated = np.diff(path_distance(T_world_camera_unscaled[:_REFERENCE_FRAMES]))
    true = np.diff(path_distance(T_world_camera_true[:_REFERENCE_FRAMES]))
    if estimated.sum() <= 0 or true.sum() <= 0:
        return Failed(f"the camera does not move within the first {_REFERENCE_FRAMES} frames")
    value = float(true.sum() / estimated.sum())
    moving = estimated > 0.1 * estimated.mean()
    spread = float(np.std(true[moving] / estimated[moving] / value))
    return ScaleEstimate(value, spread, len(estimated) + 1)


def known_frames(config: ScaleConfig, stamps: FloatArray) -> Ends:
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
            index = int(np.abs(stamps - stamp).argmin())
            inside = bool(stamps[0] <= stamp <= stamps[-1])
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
    ends: Ends, known_m: float, T_world_camera_unscaled: FloatArray
) -> ScaleEstimate | Failed:
    """The known distance of two frames, metres, over their estimated distance."""
    first, second = T_world_camera_unscaled[[*ends], :3, 3]
    apart = length_of(second - first)
    if not apart > 0:
        return Failed(f"the camera does not move between frames {ends[0]} and {ends[1]}")
    return ScaleEstimate(known_m / apart, 0.0, 2)
