"""Runs that go on: an old drive with the frames that follow it, or a run that did not end from its last kept state."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from erfsfm.common.readers.frame_range import overlapping
from slam.config.sections import SlamConfig, load_config
from slam.frames import Sequence as FrameSequence
from slam.pipeline.checkpoint import SessionCheckpoint
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics, Provenance, Recording
from slam.runtime.errors import ConfigError, RunError
from slam.runtime.run_files import CONFIG, DRIVE, UNFINISHED
from slam.runtime.storage.record import Missing, known
from slam.sequences.growing import GrowingSequence

logger = logging.getLogger(__name__)

# sections that the pass over the frames depends on: `run --continue` cannot change them
_FIXED_SECTIONS = ("depth", "visual_odometry", "gaps", "road", "scale", "loops", "keyframes")


def provenance_to_resume(
    continues: Path, metrics: Metrics, output: Path | None, recording: Recording
) -> Provenance | None:
    """What a run that did not end was run on, where it is to go on in its own folder; else None.

    Args:
        continues: its folder.
        metrics: of that run.
        output: where to write; None or the same folder to go on.
        recording: the options that name the recording; none, or those of the run.

    Raises:
        RunError: it was killed before it wrote what it is run on.
    """
    if metrics.status == "ok" or (output is not None and output.resolve() != continues.resolve()):
        return None
    provenance = metrics.provenance
    if isinstance(provenance, Missing) or isinstance(provenance.recording, Missing):
        raise RunError(f"{continues} does not record what it was run on: run the sequence again")
    return provenance if not recording.tree() or recording == provenance.recording else None


def inputs_to_continue(folder: Path, metrics: Metrics, gps: Path | None, seed: int | None) -> tuple[Path | None, int]:
    """GPS track and seed for the frames that follow a run: as given, else by the metrics of that run.

    Raises:
        RunError: its track is not there any more.
    """
    track = known(metrics.provenance.recording.gps)
    if gps is None and track is not None:
        gps = Path(track)
        if not gps.exists():
            raise RunError(f"{folder} was run with the GPS track {gps}, which is not there: give it with --gps FILE")
        logger.info("the GPS track of %s holds for the frames that follow: %s", folder, gps)
    return gps, (known(metrics.provenance.seed) or 0) if seed is None else seed


def settings_to_resume(folder: Path, config: str | Path | None, overrides: Sequence[str]) -> SlamConfig:
    """The configuration of a run that goes on, changed where the pass over the frames does not depend on it.

    Raises:
        ConfigError: another change.
    """
    if not (folder / CONFIG).is_file():
        return load_config(config, overrides)  # it was killed before its first frame
    return settings_to_continue(folder, config, overrides)


def settings_to_continue(folder: Path, config: str | Path | None, overrides: Sequence[str]) -> SlamConfig:
    """The configuration of a run to continue, changed where the pass over its frames does not depend on it.

    Raises:
        ConfigError: another change, or another configuration.
        RunError: the run has none.
    """
    if config is not None:
        raise ConfigError(f"the configuration of {folder} is used to continue it: leave out --config")
    own = load_config(RunFolder(folder).require(CONFIG))
    settings = load_config(folder / CONFIG, overrides)
    # another path may lead to the same source, or to more files of it: its identity is compared later
    after = {name: getattr(own.depth, name) for name in ("source", "refine", "fusion")}
    depth = settings.depth.model_copy(update=after)
    compared = settings.model_copy(update={"depth": depth})
    for name in _FIXED_SECTIONS:
        if getattr(compared, name) != getattr(own, name):
            raise ConfigError(
                f"{name} cannot be changed for {folder}: leave out --set {name}..., or run from the first frame"
            )
    kept, now = own.mapping, settings.mapping
    if own.output.keep == "keyframes" and (kept.width_px, kept.frame_stride) != (now.width_px, now.frame_stride):
        raise ConfigError(
            f"mapping.width_px and mapping.frame_stride are those of the keyframes that {folder} kept: leave them out, "
            "or run from the first frame"
        )
    return settings


def require_other_output(continues: Path, output: Path | None) -> None:
    """Refuse to write the whole drive over the run that it continues.

    Raises:
        RunError: it is the same folder.
    """
    if output is not None and continues.resolve() in (output.resolve(), (output / UNFINISHED).resolve()):
        raise RunError(
            f"{continues} is the run to continue, and would be lost with --output {output}: choose another --output"
        )


def recording_to_resume(folder: Path) -> FrameSequence | None:
    """The drive of a live run up to its last kept state, for its images are gone; None of another run.

    Raises:
        RunError: a damaged file.
    """
    kept = SessionCheckpoint.read(folder / DRIVE) if (folder / DRIVE).is_file() else None
    if kept is None or kept.sources:
        return None
    logger.info("the live drive of %s is finished without the frames after its last kept state", folder)
    return GrowingSequence(kept.intrinsics, kept.camera_height_m, kept.stamps, kept.name)


def state_to_resume(folder: Path, recording: FrameSequence, is_mapped: bool) -> SessionCheckpoint | None:
    """The last kept state of a run that did not end; None where it begins again.

    That is where it kept none, or its map is to be made of keyframes that were not kept.

    Raises:
        RunError: a damaged file, or the recording is not the same any more.
    """
    if not (folder / DRIVE).is_file():
        return None
    checkpoint = SessionCheckpoint.open(folder)
    same = (
        checkpoint.sources == recording.provenance()
        and checkpoint.intrinsics == recording.intrinsics
        and checkpoint.camera_height_m == recording.camera_height_m
        and np.array_equal(checkpoint.stamps, recording.stamps)
    )
    if not same:
        raise RunError(
            f"{recording.name} is not the recording that {folder} was run on, or it has changed since: give the same, "
            "or run it from its first frame in another --output"
        )
    if is_mapped and checkpoint.is_whole and checkpoint.sources and not checkpoint.state.drive.keyframes:
        logger.warning("the run in %s begins again for its map: it kept no keyframes (output.keep=keyframes)", folder)
        return None
    return checkpoint


def state_to_continue(folder: Path, following: FrameSequence) -> SessionCheckpoint:
    """The state after the last frame of a run, if these frames can follow it.

    Raises:
        RunError: the run has not ended, kept nothing, or has some of these frames.
    """
    checkpoint = SessionCheckpoint.open(folder)
    if not checkpoint.is_whole:
        raise RunError(
            f"{folder} was ended before its last frame: let it go on first, with 'erfsfm-slam run --continue {folder}'"
        )
    ranges = [name for name in following.provenance() if name.endswith("]")]  # a simulated world has none
    twice = overlapping(ranges, checkpoint.sources)
    if twice:
        raise RunError(f"{', '.join(twice)} holds frames of {folder}: give those that follow, with --frames A:B")
    return checkpoint
