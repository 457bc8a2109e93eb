"""The needs of a configuration, which are checked before the first frame of a sequence."""

from __future__ import annotations

from slam.config.sections import SlamConfig
from slam.frames import Sequence
from slam.frontend.lidar_odometry import has_scans
from slam.frontend.scale.scale_estimate import known_frames, resolve_mode
from slam.runtime.errors import SlamError
from slam.sequences.recording import GrowingSequence


def require_possible(sequence: Sequence, config: SlamConfig, shortest: int, has_gps: bool = False) -> None:
    """Check that a sequence has what the configuration of a run needs.

    Args:
        sequence: to run on; one that grows needs no frame yet.
        config: of the run.
        shortest: number of frames of one snippet of the networks.
        has_gps: whether a GPS track was given.

    Raises:
        SlamError: too few frames, or the sequence lacks what the configuration needs.
    """
    grows = isinstance(sequence, GrowingSequence)
    if len(sequence) < shortest and not grows:
        raise SlamError(
            f"{sequence.name} has {len(sequence)} frames, and one snippet of these networks has {shortest}: "
            "choose a longer range"
        )
    mode = resolve_mode(config.scale, sequence.camera_height_m, has_gps)
    wants_lidar = {"scale.mode=lidar": mode == "lidar", "lidar.factors=true": config.lidar.factors}
    for setting in (name for name, is_wanted in wants_lidar.items() if is_wanted and not has_scans(sequence)):
        raise SlamError(
            f"{setting} needs LiDAR scans of neighbouring frames and their calibration; {sequence.name} has none: "
            "leave the setting out or give a sequence with scans"
        )
    if config.lidar.factors and mode == "none":
        raise SlamError(
            f"lidar.factors=true is in metres, and lengths of {sequence.name} are in camera heights: "
            "choose scale.mode=lidar or give a camera height"
        )
    if mode == "reference" and sequence.reference is None:
        raise SlamError(f"scale mode reference needs true poses; {sequence.name} has none: choose another scale.mode")
    if mode == "camera-height" and sequence.camera_height_m is None:
        raise SlamError(
            f"scale mode camera-height needs a known height; {sequence.name} has none: give a camera.yaml "
            "with camera_height_m (fov=DEGREES has none) or choose scale.mode=none"
        )
    if mode == "gps" and not has_gps:
        raise SlamError("scale mode gps needs a GPS track: give --gps FILE or choose another scale.mode")
    if mode == "known" and grows:
        raise SlamError(
            f"scale mode known needs frames of a whole sequence, and {sequence.name} grows: choose another scale.mode"
        )
    if mode == "known":
        known_frames(config.scale, sequence.stamps)
