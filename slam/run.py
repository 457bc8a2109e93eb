"""One run from start to end: sequence and weights in, a run folder out."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from erfsfm import __version__
from erfsfm.errors import ErfsfmError
from erfsfm.inference import DepthPosePredictor, commit
from erfsfm.threads import limit_library_threads
from slam.config import SlamConfig, dump_yaml, load_config
from slam.continuation import (
    provenance_to_resume,
    require_other_output,
    settings_to_continue,
    settings_to_resume,
    state_to_continue,
    state_to_resume,
)
from slam.errors import RunError, SlamError
from slam.frames import Intrinsics
from slam.frames import Sequence as FrameSequence
from slam.loops.places import PLACES, Places
from slam.pipeline.batch import Progress, SlamPipeline, SlamResult
from slam.pipeline.checkpoint import DRIVE, KEYFRAMES, SessionCheckpoint, write_keyframes
from slam.pipeline.journal import Journal, clear_journal
from slam.pipeline.observer import ObserverState
from slam.prediction.assembly import make_predictor, open_depth
from slam.prediction.depth_folder import FrameNumbers
from slam.prediction.depth_source import DepthSource, mixed_sha256
from slam.results.depth import DepthQuality
from slam.results.folder import RunFolder
from slam.results.gps import write_places
from slam.results.map import write_map
from slam.results.map_view import write_map_views
from slam.results.metrics import estimate_metrics, lidar_trajectory, whole_metrics
from slam.results.output import check_output
from slam.results.report import DepthExample, write_report
from slam.results.rerun import write_rerun
from slam.results.run_log import LOG, RunLog, run_log
from slam.results.summary import Provenance, as_json, describe_start
from slam.runtime.imports import import_rerun
from slam.runtime.signals import Terminated, raising_on_termination
from slam.sequences.catalogue import open_sequence
from slam.sequences.continued import Continued
from slam.sequences.excerpt import Excerpt
from slam.sequences.gps import read_gps

logger = logging.getLogger(__name__)


class RunOptions(TypedDict, total=False):
    """Keyword arguments of `run_slam`; defaults and meanings as in `RunRequest`."""

    camera: Path | None
    weights: str | Path
    config: str | Path | None
    overrides: Sequence[str]
    frames: str | None
    output: Path | None
    seed: int
    device: str
    progress: Progress | None
    command: str
    cache: Path | None
    rerun: Path | None
    continues: Path | None
    gps: Path | None


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
        seed: of everything random.
        device: ``auto``, ``cpu`` or ``cuda``.
        progress: called with (stage, done, total).
        command: recorded in the metrics.
        cache: folder of network outputs and image measurements; None computes all of them.
        rerun: ``.rrd`` file to write for the rerun viewer, an optional extra.
        continues: a run folder whose last frame comes right before the first of these, by the same camera; its
            configuration is used, and the new folder has the whole drive. A run that did not end goes on in its own
            folder, with its recording, weights and seed.
        gps: a track of the drive, CSV or NMEA, see ``docs/gps.md``.
    """

    dataset: str | Path | None = None
    sequence: str | None = None
    camera: Path | None = None
    weights: str | Path = "default"
    config: str | Path | None = None
    overrides: Sequence[str] = ()
    frames: str | None = None
    output: Path | None = None
    seed: int = 0
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
        SlamError, ErfsfmError: one line. However a run ends, its folder keeps its results and the reason.
    """
    request = RunRequest(dataset, sequence, **options)
    with run_log() as log, raising_on_termination() as ignore_signals:
        job, folder = _begin(request)
        folder.write_metrics(describe_start(job.provenance))
        try:
            log.begin(folder.path / LOG)
            with limit_library_threads():
                _run(job, folder)
        except BaseException as error:
            ignore_signals()
            _leave_failure(folder, log, job.settings.output.report, error)
            if folder.replaces is not None and isinstance(error, SlamError):
                kept = f"{folder.replaces} keeps its earlier run, this one is in {folder.path}"
                raise RunError(f"{error}; {kept}") from error
            raise
        return folder


@dataclass(frozen=True)
class _Job:
    """A run that passed all checks."""

    request: RunRequest
    settings: SlamConfig
    recording: FrameSequence
    pipeline: SlamPipeline
    provenance: Provenance
    predictors_sha256: str
    checkpoint: SessionCheckpoint | None

    def checkpoint_of(self, state: ObserverState) -> SessionCheckpoint:
        """What is kept of this run after some of its frames."""
        return SessionCheckpoint.of(self.recording, state, self.predictors_sha256)


def _begin(request: RunRequest) -> tuple[_Job, RunFolder]:
    """Check everything, then make the folder of a new run, or go on in that of one that did not end."""
    if request.continues is not None:
        provenance = provenance_to_resume(request.continues, request.output, _recording(request))
        if provenance is not None:
            return _resume(request, request.continues, provenance)
        require_other_output(request.continues, request.output)
    job = _prepare(request)
    return job, RunFolder.create(request.output, Path(job.settings.output.root), job.recording.name)


def _resume(request: RunRequest, place: Path, provenance: dict[str, Any]) -> tuple[_Job, RunFolder]:
    """A run that did not end, on what it was run on, from its last kept state."""
    named = provenance["recording"]
    files = {name: Path(named[name]) if name in named else None for name in ("dataset", "camera", "gps")}
    words = {name: named.get(name) for name in ("sequence", "frames")}
    weights = provenance["weights"] if request.weights == "default" else request.weights
    seed = request.seed or provenance["seed"]
    same = replace(request, **files, **words, weights=weights, seed=seed, output=place, continues=None)  # type: ignore[arg-type]
    job = _prepare(same, place)
    logger.info("the run in %s goes on at frame %d", place, job.pipeline.first)
    return job, RunFolder.resume(place)


def _prepare(request: RunRequest, resumes: Path | None = None) -> _Job:
    """Open and check all inputs of a run; writes nothing but the cache's folder."""
    if request.output is not None:
        check_output(request.output)
    if request.rerun is not None:
        import_rerun()
    settings = _settings(request, resumes)
    dataset = None if request.dataset is None else Path(request.dataset)
    recording = open_sequence(dataset, request.sequence, request.camera, request.frames)
    networks = DepthPosePredictor.from_weights(request.weights, request.device).freeze()
    checkpoint, first = None, 0
    following = recording
    if resumes is not None:
        checkpoint = state_to_resume(resumes, recording)
    elif request.continues is not None:
        checkpoint = state_to_continue(request.continues, following)
        recording = checkpoint.continued(following)
        first = len(recording) - len(following)
    source = open_depth(settings.depth, recording.intrinsics, _frame_numbers(following, first))
    sha256 = mixed_sha256(networks.sha256, source)
    if checkpoint is not None and checkpoint.weights_sha256 != sha256:
        raise RunError(
            f"{resumes or request.continues} was run with other weights or another depth source: continue it with the "
            "same --weights and depth.source"
        )
    predictor, get_or_compute = make_predictor(networks, source, settings.depth, recording.intrinsics, request.cache)
    rest = get_or_compute, checkpoint, request.seed, None if request.gps is None else read_gps(request.gps)
    pipeline = SlamPipeline(recording, predictor, settings, request.progress, networks.noise, *rest)
    pipeline.require_possible()
    provenance = _provenance(request, networks, recording, source)
    return _Job(request, settings, recording, pipeline, provenance, sha256, checkpoint)


def _settings(request: RunRequest, resumes: Path | None) -> SlamConfig:
    if resumes is not None:
        return settings_to_resume(resumes, request.config, request.overrides)
    if request.continues is not None:
        return settings_to_continue(request.continues, request.config, request.overrides)
    return load_config(request.config, request.overrides)


def _frame_numbers(recording: FrameSequence, first: int) -> FrameNumbers:
    """The frames of this run in their recording, by which files of depth are found."""
    if isinstance(recording, Excerpt):
        return FrameNumbers(len(recording), recording.start, len(recording.base), first)
    return FrameNumbers(len(recording), 0, len(recording), first)


def _provenance(
    request: RunRequest, networks: DepthPosePredictor, recording: FrameSequence, source: DepthSource | None
) -> Provenance:
    return Provenance(
        version=__version__,
        commit=commit(),
        command=request.command,
        seed=request.seed,
        device=str(networks.device),
        weights=str(request.weights),
        weights_sha256=networks.sha256,
        weights_licence=networks.record.licence,
        trained_on=networks.record.trained_on,
        leak=bool(networks.leaks(recording.provenance())),
        depth_source="network" if source is None else source.name,
        depth_sha256=networks.sha256 if source is None else source.sha256,
        recording=_recording(request),
    )


def _recording(request: RunRequest) -> dict[str, str]:
    """The options that name the recording; files by their whole paths, for it may be opened from another folder."""
    files = {"dataset": request.dataset, "camera": request.camera, "gps": request.gps}
    named = {name: Path(path) for name, path in files.items() if path is not None}
    places = {name: str(path.absolute() if path.exists() else path) for name, path in named.items()}
    words = {"sequence": request.sequence, "frames": request.frames}
    return places | {name: word for name, word in words.items() if word is not None}


def _run(job: _Job, folder: RunFolder) -> None:
    """Estimate, then map, then report; each is on disk before the next begins."""
    folder.write_text("config.yaml", dump_yaml(job.settings))
    estimate = job.pipeline.estimate(_journal(job, folder.path))
    _write_estimate(folder, estimate, job)
    clear_journal(folder.path)
    metrics = estimate_metrics(estimate, job.recording, job.provenance, job.settings.gps.factors)
    folder.write_metrics(metrics)
    folder.publish()
    quality = DepthQuality(job.recording, estimate.scale.mode)
    result = replace(estimate, map=job.pipeline.fuse(estimate, quality.add, folder.path))
    numbers = write_map(folder, result, job.recording, job.request.progress)
    depth = quality.summary(job.settings.depth.refine != "none")
    folder.write_metrics(whole_metrics(metrics, result, job.recording, numbers, depth))
    views = write_map_views(folder, job.settings.output.viewer_triangles)
    if job.settings.output.report:
        examples = [DepthExample(i, image, depth) for i, image, depth in result.observations.examples]
        write_report(folder, examples, views)
    if job.request.rerun is not None:
        write_rerun(job.request.rerun, result, job.recording.intrinsics, job.settings.mapping.voxel_size_m)


def _journal(job: _Job, folder: Path) -> Journal | None:
    """Where the state of the pass is kept; not of a drive whose first frames are in another folder."""
    keep = job.settings.output.keep
    if keep == "nothing" or isinstance(job.recording, Continued):
        return None
    journal = Journal(folder, job.checkpoint_of, with_keyframes=keep == "keyframes")
    if job.checkpoint is not None:
        journal.begin_after(job.checkpoint.state.seen)
    return journal


def _write_estimate(folder: RunFolder, result: SlamResult, job: _Job) -> None:
    """Trajectories, graph, loops and places, and what ``run --continue`` needs."""
    for name in ("network", "odometry", "optimised"):
        folder.write_trajectory(f"trajectory_{name}", getattr(result, name))
    if result.reference is not None:
        folder.write_trajectory("reference", result.reference)
    write_places(folder, result, job.recording.name)
    lidar = lidar_trajectory(result)
    if lidar is not None:
        folder.write_trajectory("trajectory_lidar", lidar)
    result.graph.write_g2o(folder.path / "graph.g2o")
    folder.write_text("loops.json", as_json(result.loops.details()))
    folder.write(PLACES, _places(result, job.recording.intrinsics).write)
    keep = job.settings.output.keep
    if keep != "nothing":
        folder.write(DRIVE, job.checkpoint_of(result.state).write)
    if keep == "keyframes":
        folder.write(KEYFRAMES, lambda path: write_keyframes(path, result.state.seen.keyframes))


def _places(result: SlamResult, intrinsics: Intrinsics) -> Places:
    """The camera, and every view with its points, in the unit and at the poses of the optimised trajectory."""
    views = tuple(view.scaled(float(result.scale.per_frame[view.index])) for view in result.observations.views)
    T_world_camera = result.optimised.T_world_camera[np.array([view.index for view in views], dtype=np.intp)]
    return Places(intrinsics, views, T_world_camera)


def _leave_failure(folder: RunFolder, log: RunLog, report: bool, error: BaseException) -> None:
    """Write the reason of the failure to the folder; errors of writing it are ignored, so the first one is raised."""
    known = isinstance(error, SlamError | ErfsfmError | Terminated)
    reason = str(error) if known else " ".join(f"{type(error).__name__}: {error}".split()).rstrip(": ")
    log.failed(reason)
    with suppress(SlamError, OSError):
        folder.write_metrics(folder.metrics() | {"status": "failed", "reason": reason})
        if report:
            write_report(folder, [], None)
