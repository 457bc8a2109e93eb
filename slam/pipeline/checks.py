"""What a run needs before its first frame, and what is doubtful after its last one."""

from __future__ import annotations

import logging

from slam.config.sections import SlamConfig
from slam.frames import Mask, Sequence, runs
from slam.frontend.drive import DOUBLED, Drive
from slam.frontend.image_gate import ImageGate
from slam.frontend.lidar_odometry import has_scans
from slam.frontend.measured import named
from slam.frontend.scale import known_frames, resolve_mode
from slam.runtime.errors import SlamError
from slam.sequences.recording import GrowingSequence

logger = logging.getLogger(__name__)

# real drives with automatic exposure have 0.13 at ten frames a second and 0.51 at two
_ROLLING_EXPOSURE = 0.6
_LEAST_COMPARED = 30
_LEAST_STANDING, _MOST_STANDING = 0.02, 0.6  # of the image


def require_possible(
    sequence: Sequence, config: SlamConfig, shortest: int, has_gps: bool = False
) -> None:
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
    for setting in (
        name for name, is_wanted in wants_lidar.items() if is_wanted and not has_scans(sequence)
    ):
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
        raise SlamError(
            f"scale mode reference needs true poses; {sequence.name} has none: choose another scale.mode"
        )
    if mode == "camera-height" and sequence.camera_height_m is None:
        raise SlamError(
            f"scale mode camera-height needs a known height; {sequence.name} has none: give a camera.yaml "
            "with camera_height_m (fov=DEGREES has none) or choose scale.mode=none"
        )
    if mode == "gps" and not has_gps:
        raise SlamError(
            "scale mode gps needs a GPS track: give --gps FILE or choose another scale.mode"
        )
    if mode == "known" and grows:
        raise SlamError(
            f"scale mode known needs frames of a whole sequence, and {sequence.name} grows: choose another scale.mode"
        )
    if mode == "known":
        known_frames(config.scale, sequence.stamps)


def warn_of_images(gate: ImageGate, fixed: Mask | None) -> None:
    """Warn of an exposure that rolls, and of a part of the image that does not show the world."""
    if gate.compared >= _LEAST_COMPARED and gate.exposed > _ROLLING_EXPOSURE * gate.compared:
        logger.warning(
            "the exposure rolls: %d of %d images are more than a tenth brighter or darker than the one before; fix the "
            "exposure, or its flicker under lamps",
            gate.exposed,
            gate.compared,
        )
    if fixed is not None and fixed.mean() > _LEAST_STANDING:
        logger.warning(
            "%.0f %% of the image stand still while the camera moves (bars, a logo, the bonnet): no corner, depth or "
            "road is taken from there",
            100 * fixed.mean(),
        )
    if fixed is not None and fixed.mean() > _MOST_STANDING:
        logger.warning(
            "little of the world is left: mount the camera so that it sees more of the road, or give a mask in "
            "camera.yaml if the part was found wrongly"
        )


def warn_of_doubts(drive: Drive) -> None:
    """Warn of gaps, of segments, whose places are guesses, and of a frozen end: did the camera stand there?"""
    gaps, later, doubled = drive.interpolated, drive.segments[1:], drive.doubled
    if gaps:
        more = ", ..." if len(set(gaps.values())) > 1 else ""
        logger.warning("frames %s are interpolated: %s%s", named(gaps), gaps[min(gaps)], more)
    if later:
        begins = named([segment.first for segment in later])
        logger.warning(
            "a new segment of the drive begins at frame %s (%s): its place relative to the frames before is a guess",
            begins,
            later[0].reason,
        )
    if doubled:
        logger.warning("of %d frames %s: %s", len(doubled), DOUBLED, named(doubled))
    end = len(drive) - 1
    for first, last in runs(drive.measured.repeated):
        if last == end and end not in drive.interpolated:
            logger.warning(
                "frames %d to %d, the last ones, repeat frame %d: the camera is taken to stand; if the video "
                "froze, leave them out with --frames",
                first,
                last,
                first - 1,
            )
