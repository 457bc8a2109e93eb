"""One run from start to end: sequence and weights in, a run folder out."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import scipy

from erfsfm import __version__, photometric_residual
from erfsfm.errors import ErfsfmError
from erfsfm.inference import DepthPosePredictor, commit, overlapping
from erfsfm.threads import limit_library_threads
from slam import frontend, loops, se3
from slam.config import OutputConfig, SlamConfig, dump_yaml, load_config
from slam.errors import ConfigError, RunError, SlamError
from slam.frames import Intrinsics
from slam.frames import Sequence as FrameSequence
from slam.loops.places import PLACES, Places
from slam.pipeline.batch import Progress, SlamPipeline, SlamResult
from slam.pipeline.checkpoint import DRIVE, KEYFRAMES, SessionCheckpoint, write_keyframes
from slam.prediction.networks import NetworkPredictor
from slam.results.folder import RunFolder
from slam.results.map import write_map
from slam.results.metrics import lidar_trajectory, run_metrics
from slam.results.report import DepthExample, write_report
from slam.results.rerun import write_rerun
from slam.results.summary import (
    Provenance,
    as_json,
    describe_failure,
)
from slam.runtime.imports import import_rerun
from slam.sequences.catalogue import open_sequence
from slam.storage.cache import CacheNamespace, DiskCache, GetOrCompute, fingerprint, without_cache

logger = logging.getLogger(__name__)

# what a pass over the frames depends on
_SETTLED = ("geometry", "gaps", "road", "scale", "loops")


def run_slam(
    dataset: str | Path | None = None,
    sequence: str | None = None,
    camera: Path | None = None,
    weights: str | Path = "default",
    config: str | Path | None = None,
    overrides: Sequence[str] = (),
    frames: str | None = None,
    output: Path | None = None,
    seed: int = 0,
    device: str = "auto",
    progress: Progress | None = None,
    command: str = "slam.run_slam",
    cache: Path | None = None,
    rerun: Path | None = None,
    continues: Path | None = None,
) -> RunFolder:
    """Run the whole system on one sequence.

    Args:
        dataset: KITTI odometry root, KITTI raw drive, TUM folder, image folder or video; None with no
            ``sequence`` is the embedded simulated street.
        sequence: name inside the data set.
        camera: ``camera.yaml`` of a folder or video, where none lies beside it.
        weights: a shipped name or a training output folder.
        config: a YAML file or a shipped name; None for the defaults.
        overrides: ``section.key=value`` each.
        frames: ``A:B``, half-open.
        output: the run folder itself; None makes ``results/<stamp>_<sequence>``.
        seed: of everything random.
        device: ``auto``, ``cpu`` or ``cuda``.
        progress: told of (stage, done, total).
        command: recorded in the metrics.
        cache: folder that keeps the networks' answers and what images alone determine; None asks anew.
        rerun: ``.rrd`` file to write for the rerun viewer, an optional extra.
        continues: a run folder whose last frame comes right before the first of these, taken by the same camera; its
            configuration holds, and the new folder has the whole drive.

    Returns:
        The run folder.

    Raises:
        SlamError, ErfsfmError: one line; whatever ends a run, a folder already made holds what there is and says why.
    """
    if rerun is not None:
        import_rerun()  # better missed before the run than after it
    settings = load_config(config, overrides) if continues is None else _continued(continues, config, overrides, output)
    recording = open_sequence(Path(dataset) if dataset is not None else None, sequence, camera, frames)
    networks = DepthPosePredictor.from_weights(weights, device).freeze()
    drive = None if continues is None else _drive(continues, networks.sha256, recording)
    if drive is not None:
        recording = drive.continued(recording)
    memory = None if cache is None else DiskCache(cache)
    get_or_compute = without_cache if memory is None else CacheNamespace(memory, _code()).get_or_compute
    answers = without_cache if memory is None else _answers(networks, memory)
    predictor = NetworkPredictor(networks, recording.intrinsics, get_or_compute, answers)
    provenance = Provenance(
        version=__version__,
        commit=commit(),
        command=command,
        seed=seed,
        device=str(networks.device),
        weights=str(weights),
        weights_sha256=networks.sha256,
        weights_licence=networks.record.licence,
        trained_on=networks.record.trained_on,
        leak=bool(networks.leaks(recording.provenance())),
    )
    folder = RunFolder.create(output, Path(settings.output.root), recording.name)
    folder.write_text("config.yaml", dump_yaml(settings))
    with _logging_to(folder.path / "run.log"):
        try:
            pipeline = SlamPipeline(
                recording, predictor, settings, progress, networks.noise, get_or_compute, drive, seed
            )
            with limit_library_threads():
                result = _run(folder, pipeline, recording, provenance, settings.output)
            if rerun is not None:
                write_rerun(rerun, result, recording.intrinsics, settings.mapping.voxel_size_m)
            return folder
        except BaseException as error:
            _leave_failure(folder, provenance, settings.output.report, error)
            raise


def _continued(continues: Path, config: str | Path | None, overrides: Sequence[str], output: Path | None) -> SlamConfig:
    """The configuration of a run to continue, with changes to what is not settled by the frames seen."""
    if config is not None:
        raise ConfigError(f"the configuration of {continues} holds for what continues it: leave out --config")
    if output is not None and output.resolve() == continues.resolve():
        raise RunError(f"{output} is the run to continue, and would be lost with this one: choose another --output")
    own = load_config(RunFolder.open(continues).require("config.yaml"))
    settings = load_config(continues / "config.yaml", overrides)
    for name in _SETTLED:
        if getattr(settings, name) != getattr(own, name):
            raise ConfigError(f"{name} is settled by the frames of {continues}: leave out --set {name}..., or run anew")
    return settings


def _drive(continues: Path, weights_sha256: str, following: FrameSequence) -> SessionCheckpoint:
    """What is kept of a run to continue, if these networks and frames can go on with it."""
    drive = SessionCheckpoint.open(continues)
    if drive.weights_sha256 != weights_sha256:
        raise RunError(f"{continues} was run with other weights: continue it with the same --weights")
    ranges = [name for name in following.provenance() if name.endswith("]")]  # a simulated world has none
    twice = overlapping(ranges, drive.sources)
    if twice:
        raise RunError(f"{', '.join(twice)} holds frames of {continues}: give those that follow, with --frames A:B")
    return drive


def _leave_failure(folder: RunFolder, provenance: Provenance, report: bool, error: BaseException) -> None:
    """Say in the folder why the run ended; where even that fails, the first error is the one to hear about."""
    known = isinstance(error, SlamError | ErfsfmError)
    reason = str(error) if known else " ".join(f"{type(error).__name__}: {error}".split()).rstrip(": ")
    logger.error("the run failed: %s", reason)
    with suppress(SlamError):
        folder.write_metrics(describe_failure(provenance, reason))
        if report:
            write_report(folder, [], None, None)


def _answers(networks: DepthPosePredictor, cache: DiskCache) -> GetOrCompute:
    """The cache of the networks' answers; GPU and CPU answer a little differently and share none."""
    network = networks.record.network.model_dump_json()
    return CacheNamespace(cache, f"{networks.sha256} {network} {networks.device.type}").get_or_compute


def _code() -> str:
    """Whatever measures images: an entry names it, so that there is no version to forget."""
    folders = (Path(package.__path__[0]) for package in (frontend, loops))
    sources = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
    versions = (f"{library.__name__} {library.__version__}" for library in (np, cv2, scipy))
    return " ".join((fingerprint(*sources, Path(se3.__file__), Path(photometric_residual.__file__)), *versions))


def _run(
    folder: RunFolder, pipeline: SlamPipeline, sequence: FrameSequence, provenance: Provenance, output: OutputConfig
) -> SlamResult:
    estimate = pipeline.estimate()
    _write_estimate(folder, estimate, sequence.intrinsics)
    if output.keep != "nothing":
        folder.write(DRIVE, SessionCheckpoint.of(sequence, estimate.state, provenance.weights_sha256).write)
    if output.keep == "keyframes":
        folder.write(KEYFRAMES, lambda path: write_keyframes(path, estimate.state.seen.keyframes))
    result = replace(estimate, map=pipeline.fuse(estimate))
    surface = write_map(folder, result, sequence)
    folder.write_metrics(run_metrics(result, sequence, provenance, surface.summary))
    if output.report:
        examples = [DepthExample(i, image, depth) for i, image, depth in result.observations.examples]
        write_report(folder, examples, surface.points, surface.colours)
    return result


def _write_estimate(folder: RunFolder, result: SlamResult, intrinsics: Intrinsics) -> None:
    """Trajectories, graph, loops and places: kept even where the map fails."""
    for name in ("network", "odometry", "optimised"):
        folder.write_trajectory(f"trajectory_{name}", getattr(result, name))
    if result.reference is not None:
        folder.write_trajectory("reference", result.reference)
    lidar = lidar_trajectory(result)
    if lidar is not None:
        folder.write_trajectory("trajectory_lidar", lidar)
    folder.write("graph.g2o", result.graph.write_g2o)
    folder.write_text("loops.json", as_json(result.loops.details()))
    folder.write(PLACES, _places(result, intrinsics).write)


def _places(result: SlamResult, intrinsics: Intrinsics) -> Places:
    """The camera, and every view with its points, in the unit and at the poses of the optimised trajectory."""
    views = tuple(view.scaled(float(result.scale.per_frame[view.index])) for view in result.observations.views)
    T_world_camera = result.optimised.T_world_camera[np.array([view.index for view in views], dtype=np.intp)]
    return Places(intrinsics, views, T_world_camera)


@contextmanager
def _logging_to(path: Path) -> Iterator[None]:
    """Send the package's log to a file, line by line, beside wherever it goes already."""
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger("slam")
    level = root.level
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    try:
        yield
    finally:
        root.removeHandler(handler)
        root.setLevel(level)
        handler.close()
