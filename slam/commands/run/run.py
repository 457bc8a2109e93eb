"""One run from start to end: sequence and weights in, a run folder out."""

from __future__ import annotations

import logging
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from erfsfm import __version__
from erfsfm.common.files import FolderLock
from erfsfm.common.progress import progress_bar, progress_lines, silent
from erfsfm.common.signals import raising_on_termination
from erfsfm.inference import DepthPosePredictor, commit
from slam.commands.run.job import Job, complete
from slam.commands.run.request import RunRequest
from slam.config.sections import SlamConfig, load_config
from slam.frames import Sequence as FrameSequence
from slam.pipeline.batch import SlamPipeline
from slam.prediction.assembly import make_predictor, open_depth
from slam.prediction.depth_folder import FrameNumbers
from slam.prediction.depth_source import DepthSource
from slam.results.folder import RunFolder
from slam.results.metrics import Provenance
from slam.results.output_folder import check_output
from slam.results.run_log import run_log
from slam.runtime.imports import import_extra
from slam.runtime.storage.files import from_anywhere
from slam.sequences.catalogue import open_sequence
from slam.sequences.excerpt import recording_of, undistortion_of
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

    All checks come before a folder is made; an earlier run in ``output`` is removed then.

    Raises:
        SlamError, ErfsfmError: one line. However a run ends, its folder keeps its results and the reason.
    """
    with run_log() as log, raising_on_termination() as ignore_signals, FolderLock() as lock:
        job = _prepare(request)
        folder = RunFolder.create(request.output, Path(job.settings.output.root), job.recording.name, lock)
        return complete(job, folder, log, ignore_signals)


def _prepare(request: RunRequest) -> Job:
    """Open and check all inputs of a run; writes nothing."""
    if request.output is not None:
        check_output(request.output)
    if request.rerun is not None:
        import_extra("rerun")
    settings = load_config(request.config, request.overrides or ())
    recording = open_sequence(request.dataset, request.sequence, request.camera, request.frames, request.truth)
    networks = DepthPosePredictor.from_weights(request.weights, request.device, "onnx")
    lens = undistortion_of(recording)
    undistort = None if lens is None else lens.apply_to_depth
    source = open_depth(settings.depth, recording.intrinsics, _frame_numbers(recording), undistort)
    predictor = make_predictor(networks, source, settings.depth, recording.intrinsics)
    track = None if request.gps is None else read_gps(request.gps)
    pipeline = SlamPipeline(recording, predictor, settings, request.progress or silent, request.seed, track)
    pipeline.require_possible()
    provenance = provenance_of(request, networks, recording, source)
    settings = _settings_from_anywhere(settings)
    return Job(settings, recording, pipeline, provenance, request.rerun, request.progress or silent)


def _settings_from_anywhere(settings: SlamConfig) -> SlamConfig:
    """The same with the source of depth by its whole path."""
    kind, colon, path = settings.depth.source.partition(":")
    if not colon:
        return settings
    depth = settings.depth.model_copy(update={"source": f"{kind}:{from_anywhere(path)}"})
    return settings.model_copy(update={"depth": depth})


def _frame_numbers(recording: FrameSequence) -> FrameNumbers:
    """The frames of this run in their recording, by which files of depth are found."""
    base, start = recording_of(recording)
    return FrameNumbers(len(recording), start, len(base))


def provenance_of(
    request: RunRequest, networks: DepthPosePredictor, recording: FrameSequence, source: DepthSource | None
) -> Provenance:
    """The input of a run: networks, depth, and the options that name the recording."""
    is_folder = Path(request.weights) == Path(networks.origin)  # else a shipped name, whatever lies here
    return Provenance(
        version=__version__,
        commit=commit(),
        command=request.command,
        seed=request.seed,
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
