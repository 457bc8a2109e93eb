"""One run from start to end: sequence and weights in, a run folder out."""

from __future__ import annotations

import logging
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from erfsfm import __version__
from erfsfm.common.lock import FolderLock
from erfsfm.common.progress import progress_bar, progress_lines, silent
from erfsfm.common.signals import raising_on_termination
from erfsfm.inference import DepthPosePredictor, commit
from slam.commands.run.continuation import (
    inputs_to_continue,
    provenance_to_resume,
    recording_to_resume,
    require_other_output,
    settings_to_continue,
    settings_to_resume,
    state_to_continue,
    state_to_resume,
)
from slam.commands.run.job import Job, complete
from slam.commands.run.request import RunRequest
from slam.config.sections import SlamConfig, load_config
from slam.frames import Sequence as FrameSequence
from slam.pipeline.batch import SlamPipeline
from slam.prediction.assembly import make_predictor, open_depth
from slam.prediction.depth_folder import FrameNumbers
from slam.prediction.depth_source import DepthSource, mixed_sha256
from slam.results.folder import RunFolder
from slam.results.metrics import Provenance
from slam.results.output_folder import check_output, whole_place
from slam.results.run_log import run_log
from slam.runtime.errors import RunError
from slam.runtime.imports import import_extra
from slam.runtime.storage.files import from_anywhere
from slam.sequences.catalogue import open_sequence
from slam.sequences.excerpt import Excerpt, undistortion_of
from slam.sequences.gps import read_gps

logger = logging.getLogger(__name__)


def run_slam(dataset: str | Path | None = None, sequence: str | None = None, **options: Any) -> RunFolder:
    """Run the whole system on one sequence.

    Without ``progress``, the log says every ten seconds (level INFO) what is done; in a notebook its cell does.

    Args:
        dataset: as in `RunRequest`.
        sequence: as in `RunRequest`.
        options: the others of `RunRequest`, by name.

    Returns:
        The run folder.

    Raises:
        TypeError: an unknown argument.
        SlamError, ErfsfmError: as `perform`.
    """
    request = RunRequest.of(dataset=dataset, sequence=sequence, **options)
    if request.progress is not None:
        return perform(request)
    in_notebook = "ipykernel" in sys.modules
    with progress_bar() if in_notebook else progress_lines(logger.info) as progress:
        return perform(replace(request, progress=progress))


def perform(request: RunRequest) -> RunFolder:
    """Run the whole system on one sequence.

    All checks come before a folder is made. An earlier run in ``output`` stays until the
    trajectories of this one are whole.

    Raises:
        SlamError, ErfsfmError: one line. However a run ends, its folder keeps its results and the reason.
    """
    with run_log() as log, raising_on_termination() as ignore_signals, FolderLock() as lock:
        return complete(*_begin(request, lock), log, ignore_signals)


def _begin(request: RunRequest, lock: FolderLock) -> tuple[Job, RunFolder]:
    """Check everything, then make the folder of a new run, or go on in that of one that did not end."""
    if request.continues is not None:
        _, metrics = RunFolder.open_with_metrics(request.continues)
        provenance = provenance_to_resume(request.continues, metrics, request.output, request.recording)
        if provenance is not None:
            lock.take(whole_place(request.continues))
            return _resume(request, request.continues, provenance)
        if not request.recording.tree():
            raise RunError(
                f"name the frames that follow those of {request.continues} (--dataset, --frames): only what did not "
                "end goes on without, in its own folder"
            )
        require_other_output(request.continues, request.output)
        gps, seed = inputs_to_continue(request.continues, metrics, request.gps, request.seed)
        request = replace(request, gps=gps, seed=seed)
    job = _prepare(request)
    return job, RunFolder.create(request.output, Path(job.settings.output.root), job.recording.name, lock)


def _resume(request: RunRequest, place: Path, before: Provenance) -> tuple[Job, RunFolder]:
    """A run that did not end, on what it was run on, from its last kept state."""
    job = _prepare(request.resumed(before, place), place)
    logger.info("the run in %s goes on at frame %d", place, job.pipeline.first)
    return job, RunFolder.resume(place)


def _prepare(request: RunRequest, resumes: Path | None = None) -> Job:
    """Open and check all inputs of a run; writes nothing."""
    if request.output is not None:
        check_output(request.output)
    if request.rerun is not None:
        import_extra("rerun")
    settings = _settings(request, resumes)
    recording = None if resumes is None else recording_to_resume(resumes)
    if recording is None:
        recording = open_sequence(request.dataset, request.sequence, request.camera, request.frames, request.truth)
    networks = DepthPosePredictor.from_weights(request.weights, request.device, "onnx")
    checkpoint, first = None, 0
    following = recording
    if resumes is not None:
        checkpoint = state_to_resume(resumes, recording, settings.mapping.enabled)
    elif request.continues is not None:
        checkpoint = state_to_continue(request.continues, following)
        recording = checkpoint.continued(following)
        first = len(recording) - len(following)
    lens = undistortion_of(following)
    undistort = None if lens is None else lens.apply_to_depth
    source = open_depth(settings.depth, recording.intrinsics, _frame_numbers(following, first), undistort)
    sha256 = mixed_sha256(networks.sha256, source)
    if checkpoint is not None and checkpoint.weights_sha256 != sha256:
        raise RunError(
            f"{resumes or request.continues} was run with other weights or another depth source: continue it with the "
            "same --weights and depth.source"
        )
    predictor = make_predictor(networks, source, settings.depth, recording.intrinsics)
    rest = checkpoint, request.seed or 0, None if request.gps is None else read_gps(request.gps)
    pipeline = SlamPipeline(recording, predictor, settings, request.progress or silent, *rest)
    pipeline.require_possible()
    provenance = provenance_of(request, networks, recording, source)
    settings = _settings_from_anywhere(settings)
    return Job(settings, recording, pipeline, provenance, sha256, checkpoint, request.rerun, request.progress or silent)


def _settings(request: RunRequest, resumes: Path | None) -> SlamConfig:
    given = request.config, request.overrides or ()
    if resumes is not None:
        return settings_to_resume(resumes, *given)
    if request.continues is not None:
        return settings_to_continue(request.continues, *given)
    return load_config(*given)


def _settings_from_anywhere(settings: SlamConfig) -> SlamConfig:
    """The same with the source of depth by its whole path."""
    kind, colon, path = settings.depth.source.partition(":")
    if not colon:
        return settings
    depth = settings.depth.model_copy(update={"source": f"{kind}:{from_anywhere(path)}"})
    return settings.model_copy(update={"depth": depth})


def _frame_numbers(recording: FrameSequence, first: int) -> FrameNumbers:
    """The frames of this run in their recording, by which files of depth are found."""
    if isinstance(recording, Excerpt):
        return FrameNumbers(len(recording), recording.start, len(recording.base), first)
    return FrameNumbers(len(recording), 0, len(recording), first)


def provenance_of(
    request: RunRequest, networks: DepthPosePredictor, recording: FrameSequence, source: DepthSource | None
) -> Provenance:
    """The input of a run: networks, depth, and the options that name the recording."""
    is_folder = Path(request.weights) == Path(networks.origin)  # else a shipped name, whatever lies here
    return Provenance(
        version=__version__,
        commit=commit(),
        command=request.command,
        seed=request.seed or 0,
        device=str(networks.device),
        weights=from_anywhere(request.weights) if is_folder else request.weights,
        weights_sha256=networks.sha256,
        weights_licence=networks.record.licence,
        trained_on=networks.record.trained_on,
        leak=bool(networks.leaks(recording.provenance())),
        depth_source="network" if source is None else source.name,
        depth_sha256=networks.sha256 if source is None else source.sha256,
        recording=request.recording,
    )
