"""One run from start to end: sequence and weights in, a run folder out."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, TypedDict, Unpack

from pydantic import Field, ValidationError
from pydantic.dataclasses import dataclass

from erfsfm import __version__
from erfsfm.common.config_tree import first_problem
from erfsfm.common.lock import FolderLock
from erfsfm.common.signals import raising_on_termination
from erfsfm.inference import DepthPosePredictor, commit
from slam.commands.run.continuation import (
    inputs_to_continue,
    provenance_to_resume,
    require_other_output,
    settings_to_continue,
    settings_to_resume,
    state_to_continue,
    state_to_resume,
    warn_of_other_noise,
)
from slam.commands.run.job import Job, complete
from slam.config.sections import SlamConfig, load_config
from slam.frames import Sequence as FrameSequence
from slam.pipeline.batch import Progress, SlamPipeline
from slam.prediction.assembly import make_predictor, open_depth
from slam.prediction.depth_folder import FrameNumbers
from slam.prediction.depth_source import DepthSource, mixed_sha256
from slam.results.folder import RunFolder
from slam.results.output import check_output, whole_place
from slam.results.run_log import run_log
from slam.results.summary import Provenance
from slam.runtime.errors import RunError
from slam.runtime.imports import import_rerun
from slam.runtime.storage.files import from_anywhere
from slam.sequences.catalogue import open_sequence
from slam.sequences.excerpt import Excerpt
from slam.sequences.gps import read_gps
from slam.sequences.undistortion import undistortion_of

logger = logging.getLogger(__name__)


class RunOptions(TypedDict, total=False):
    """Keyword arguments of `run_slam`; defaults and meanings as in `RunRequest`."""

    camera: str | Path | None
    weights: str | Path
    config: str | Path | None
    overrides: Sequence[str]
    frames: str | None
    output: str | Path | None
    seed: int | None
    device: str
    progress: Progress | None
    command: str
    cache: str | Path | None
    rerun: str | Path | None
    continues: str | Path | None
    gps: str | Path | None


@dataclass(frozen=True)
class RunRequest:
    """All inputs of a run.

    Attributes:
        dataset: a recording of a kind that ``docs/recordings.md`` lists; None with no
            ``sequence`` is the embedded simulated street.
        sequence: name inside the data set.
        camera: ``camera.yaml`` in place of the one beside the images or their calibration, or ``fov=DEGREES``.
        weights: a shipped name or a training output folder.
        config: a YAML file or a shipped name; None for the defaults.
        overrides: ``section.key=value`` each.
        frames: ``A:B``, half-open.
        output: the run folder itself; None makes ``results/<stamp>_<sequence>``.
        seed: of everything random; None is 0, or that of the run to continue.
        device: ``auto``, ``cpu`` or ``cuda``.
        progress: called with (stage, done, total).
        command: recorded in the metrics.
        cache: folder of network outputs and image measurements; None computes all of them.
        rerun: ``.rrd`` file to write for the rerun viewer, an optional extra.
        continues: a run folder whose last frame comes right before the first of these, by the same camera; its
            configuration is used, and the new folder has the whole drive. A run that did not end goes on in its own
            folder, with its recording, weights and seed.
        gps: a track of the drive, CSV or NMEA, see ``docs/gps.md``; None is that of the run to continue.
    """

    dataset: str | Path | None = None
    sequence: str | None = None
    camera: Path | None = None
    weights: str | Path = "default"
    config: str | Path | None = None
    overrides: Sequence[str] = ()
    frames: str | None = None
    output: Path | None = None
    seed: Annotated[int, Field(ge=0, lt=2**31)] | None = None
    device: str = "auto"
    progress: Progress | None = None
    command: str = "slam.run_slam"
    cache: Path | None = None
    rerun: Path | None = None
    continues: Path | None = None
    gps: Path | None = None


def run_slam(
    dataset: str | Path | None = None, sequence: str | None = None, **options: Unpack[RunOptions]
) -> RunFolder:
    """Run the whole system on one sequence.

    All checks come before a folder is made. An earlier run in ``output`` stays until the
    trajectories of this one are whole.

    Args:
        dataset: as in `RunRequest`.
        sequence: as in `RunRequest`.
        options: the others of `RunRequest`, by name.

    Returns:
        The run folder.

    Raises:
        TypeError: an unknown argument.
        SlamError, ErfsfmError: one line. However a run ends, its folder keeps its results and the reason.
    """
    unknown = options.keys() - RunOptions.__annotations__.keys()
    if unknown:
        raise TypeError(f"run_slam has no argument {', '.join(sorted(unknown))}")
    try:
        request = RunRequest(dataset=dataset, sequence=sequence, **options)  # type: ignore[arg-type]  # text becomes a path
    except ValidationError as error:
        raise RunError(f"run_slam: {first_problem(error)}") from error
    with run_log() as log, raising_on_termination() as ignore_signals, FolderLock() as lock:
        return complete(*_begin(request, lock), log, ignore_signals)


def _begin(request: RunRequest, lock: FolderLock) -> tuple[Job, RunFolder]:
    """Check everything, then make the folder of a new run, or go on in that of one that did not end."""
    known: dict[str, Any] = {}
    if request.continues is not None:
        _, known = RunFolder.open_with_metrics(request.continues)
        provenance = provenance_to_resume(request.continues, known, request.output, _recording(request))
        if provenance is not None:
            lock.take(whole_place(request.continues))
            return _resume(request, request.continues, provenance)
        if _recording(request) == {}:
            raise RunError(
                f"name the frames that follow those of {request.continues} (--dataset, --frames): only what did not "
                "end goes on without, in its own folder"
            )
        require_other_output(request.continues, request.output)
        gps, seed = inputs_to_continue(request.continues, known, request.gps, request.seed)
        request = replace(request, gps=gps, seed=seed)
    job = _prepare(request)
    if request.continues is not None:
        warn_of_other_noise(request.continues, known, job.provenance.noise_sha256)
    return job, RunFolder.create(request.output, Path(job.settings.output.root), job.recording.name, lock)


def _resume(request: RunRequest, place: Path, provenance: dict[str, Any]) -> tuple[Job, RunFolder]:
    """A run that did not end, on what it was run on, from its last kept state."""
    named = provenance["recording"]
    files = {name: Path(named[name]) if name in named else None for name in ("dataset", "camera", "gps")}
    words = {name: named.get(name) for name in ("sequence", "frames")}
    weights = provenance["weights"] if request.weights == "default" else request.weights
    seed = provenance["seed"] if request.seed is None else request.seed
    same = replace(request, **files, **words, weights=weights, seed=seed, output=place, continues=None)  # type: ignore[arg-type]
    job = _prepare(same, place)
    warn_of_other_noise(place, {"provenance": provenance}, job.provenance.noise_sha256)
    logger.info("the run in %s goes on at frame %d", place, job.pipeline.first)
    return job, RunFolder.resume(place)


def _prepare(request: RunRequest, resumes: Path | None = None) -> Job:
    """Open and check all inputs of a run; writes nothing but the cache's folder."""
    if request.output is not None:
        check_output(request.output)
    if request.rerun is not None:
        import_rerun("--rerun")
    settings = _settings(request, resumes)
    dataset = None if request.dataset is None else Path(request.dataset)
    recording = open_sequence(dataset, request.sequence, request.camera, request.frames)
    networks = DepthPosePredictor.from_weights(request.weights, request.device, "onnx")
    checkpoint, first = None, 0
    following = recording
    if resumes is not None:
        checkpoint = state_to_resume(resumes, recording)
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
    predictor, get_or_compute = make_predictor(networks, source, settings.depth, recording.intrinsics, request.cache)
    rest = get_or_compute, checkpoint, request.seed or 0, None if request.gps is None else read_gps(request.gps)
    pipeline = SlamPipeline(recording, predictor, settings, request.progress, networks.noise, *rest)
    pipeline.require_possible()
    provenance = provenance_of(request, networks, recording, source)
    settings = _settings_from_anywhere(settings)
    return Job(settings, recording, pipeline, provenance, sha256, checkpoint, request.rerun, request.progress)


def _settings(request: RunRequest, resumes: Path | None) -> SlamConfig:
    if resumes is not None:
        return settings_to_resume(resumes, request.config, request.overrides)
    if request.continues is not None:
        return settings_to_continue(request.continues, request.config, request.overrides)
    return load_config(request.config, request.overrides)


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
        weights=from_anywhere(request.weights) if is_folder else str(request.weights),
        weights_sha256=networks.sha256,
        noise_sha256=networks.noise_sha256 or None,
        weights_licence=networks.record.licence,
        trained_on=networks.record.trained_on,
        leak=bool(networks.leaks(recording.provenance())),
        depth_source="network" if source is None else source.name,
        depth_sha256=networks.sha256 if source is None else source.sha256,
        recording=_recording(request),
    )


def _recording(request: RunRequest) -> dict[str, str]:
    """The options that name the recording."""
    files = {"dataset": request.dataset, "camera": request.camera, "gps": request.gps}
    named = {name: Path(path) for name, path in files.items() if path is not None}
    places = {name: from_anywhere(path) for name, path in named.items()}
    words = {"sequence": request.sequence, "frames": request.frames}
    return places | {name: word for name, word in words.items() if word is not None}
