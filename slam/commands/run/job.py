"""A run that passed all checks, from its first frame to its whole folder."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from erfsfm.common.errors import explained
from erfsfm.common.progress import Progress, silent
from erfsfm.common.threads import limit_library_threads
from slam.config.sections import SlamConfig, dump_yaml
from slam.evaluation.double_walls import double_wall_share
from slam.formats.ply import Ply
from slam.formats.trajectory import Trajectory
from slam.frames import Frame, Image
from slam.frames import Sequence as FrameSequence
from slam.loops.verification import OF_KEYFRAMES, LoopThresholds
from slam.mapping.filters import KeyframeDepth
from slam.pipeline.batch import SlamPipeline
from slam.pipeline.estimate import Estimate
from slam.pipeline.observer import Observer
from slam.results.depth import DepthQuality
from slam.results.estimate_metrics import estimate_metrics, lidar_trajectory, timing_of
from slam.results.folder import RunFolder
from slam.results.map_error import map_errors
from slam.results.metrics import MapMetrics, Metrics, Provenance
from slam.results.report.map_view import map_view
from slam.results.report.page import write_report
from slam.results.report.pictures import DepthPictures, loop_pictures
from slam.results.report.rendering import Picture
from slam.results.report.rerun import write_rerun
from slam.results.run_log import RunLog
from slam.runtime.attempt import attempt
from slam.runtime.errors import EmptyMapError, SlamError
from slam.runtime.run_files import CONFIG, GRAPH, LOG, LOOPS, MAP_CLOUD, MAP_MESH, PLACES
from slam.runtime.storage.record import Missing

logger = logging.getLogger(__name__)

_NO_KEYFRAMES = "no frame for the map has depth"


@dataclass(frozen=True)
class Stream:
    """Frames that come while they are taken, and who watches them.

    ``watch`` is called with the observer after every frame, ``finish`` with the estimate and the run folder;
    ``tracked`` gives the poses so far.
    """

    frames: Callable[[], Iterator[Frame]]
    watch: Callable[[Observer], None]
    finish: Callable[[Estimate, Path], None]
    tracked: Callable[[], Trajectory]


@dataclass(frozen=True)
class Job:
    """A run that passed all checks; ``rerun`` is an ``.rrd`` file to write, ``stream`` None for a recording."""

    settings: SlamConfig
    recording: FrameSequence
    pipeline: SlamPipeline
    provenance: Provenance
    rerun: Path | None = None
    progress: Progress = silent
    stream: Stream | None = None


def complete(job: Job, folder: RunFolder, log: RunLog, ignore_signals: Callable[[], None]) -> RunFolder:
    """Run to the end; however that is, the folder keeps the results and the reason.

    Raises:
        SlamError, ErfsfmError: one line.
    """
    folder.write_metrics(Metrics.of_begun_run(job.provenance))
    try:
        log.begin(folder.path / LOG)
        with limit_library_threads():
            _run(job, folder)
    except BaseException as error:
        ignore_signals()
        _leave_failure(job, folder, log, error)
        raise
    return folder


def _run(job: Job, folder: RunFolder) -> None:
    """Estimate, then map, then report; each is on disk before the next begins."""
    folder.write_text(CONFIG, dump_yaml(job.settings))
    stream = job.stream
    frames, watch = (None, None) if stream is None else (stream.frames(), stream.watch)
    estimate = job.pipeline.estimate(frames, watch, folder.write_trajectory)
    _write_estimate(folder, estimate, job)
    with estimate.stopwatch.stage("evaluation"):
        metrics = estimate_metrics(estimate, job.recording, job.provenance, job.settings.gps.factors)
    folder.write_metrics(metrics)
    if stream is not None:
        stream.finish(estimate, folder.path)
    quality, depths = DepthQuality(job.recording, estimate.scale.is_metric), DepthPictures(len(job.recording))

    def compare(keyframe: KeyframeDepth) -> None:
        depths.add(keyframe)
        with estimate.stopwatch.stage("evaluation"):
            quality.add(keyframe)

    def mapped() -> tuple[Estimate, MapMetrics]:
        result = replace(estimate, map=job.pipeline.fuse(estimate, compare))
        return result, _write_map(folder, result, job)

    found = attempt("the map", mapped)
    result, map_metrics = (estimate, MapMetrics.missing(found.reason)) if isinstance(found, Missing) else found
    depth = quality.metrics(job.settings.depth.refine != "none")
    timing = timing_of(result.stopwatch, len(job.recording))
    metrics = metrics.changed(timing=timing, depth=depth, map=map_metrics)
    folder.write_metrics(metrics)
    metrics = metrics.changed(status="ok", reason=None)
    output = job.settings.output

    def reported() -> None:
        if output.report:
            view = map_view(folder, output.viewer_triangles)
            write_report(folder, depths.pictures(), _loop_pictures(result, job), view, metrics)

    job.progress("report", 0, 1)
    attempt("the report", reported)
    folder.write_metrics(metrics)
    job.progress("report", 1, 1)
    if job.rerun is not None:
        write_rerun(job.rerun, result, job.recording.intrinsics)


def _loop_pictures(result: Estimate, job: Job) -> list[Picture]:
    """Images of accepted loops: of the recording, or of the keyframes of a live drive."""

    def image(index: int) -> Image | None:
        try:
            return job.recording.frame(index).image
        except SlamError:
            return next((each.image for each in result.drive.keyframes if each.index == index), None)

    thresholds = OF_KEYFRAMES if result.drive.maps else LoopThresholds.of_frames(job.settings.loops)
    return loop_pictures(result.loops.accepted, image, job.recording.intrinsics, thresholds)


def _write_estimate(folder: RunFolder, result: Estimate, job: Job) -> None:
    """What the pass over the frames did not write yet: trajectories by loops and graph, these, and places."""
    for name in ("odometry", "optimised"):
        folder.write_trajectory(name, getattr(result, name))
    lidar = lidar_trajectory(result)
    if lidar is not None:
        folder.write_trajectory("lidar", lidar)
    if not isinstance(result.graph, Missing):
        result.graph.write_g2o(folder.path / GRAPH)
    folder.write_text(LOOPS, json.dumps(result.loops.details(), indent=2, allow_nan=False))
    folder.write(PLACES, result.places(job.recording.intrinsics).write)


def _write_map(folder: RunFolder, result: Estimate, job: Job) -> MapMetrics:
    """Merge the submaps, write mesh and cloud, and give the metrics of the map; an empty map gives a reason."""
    if result.map is None:
        mapped = job.settings.mapping.enabled
        return MapMetrics.missing(_NO_KEYFRAMES if mapped else "fusion is switched off (mapping.enabled)")
    try:
        with result.stopwatch.stage("mesh"):
            surface = result.map.surface(job.progress)
    except EmptyMapError as error:
        logger.warning("no map: %s", error)
        return MapMetrics.missing(str(error))
    job.progress("map files", 0, 1)
    with result.stopwatch.stage("mesh"):
        surface.write_mesh(folder.path / MAP_MESH)
        surface.write_cloud(folder.path / MAP_CLOUD)
    with result.stopwatch.stage("evaluation"):
        share = double_wall_share(surface.meshes()) if result.scale.is_metric else Missing("lengths are not in metres")
        errors = map_errors(lambda: (Ply(piece).points for piece in surface.cloud_pieces()), result, job.recording)
    job.progress("map files", 1, 1)
    return MapMetrics(**asdict(result.map.statistics()), double_wall_share=share, **dict(errors))


def _leave_failure(job: Job, folder: RunFolder, log: RunLog, error: BaseException) -> None:
    """Write the reason of the failure, and of a live drive its poses, which nothing else could give again.

    Errors of writing them are ignored, so the first one is raised.
    """
    reason = explained(error) if isinstance(error, Exception) else str(error) or type(error).__name__
    log.failed(reason)
    with suppress(SlamError, OSError):
        folder.write_metrics(folder.metrics().changed(status="failed", reason=reason))
        if job.stream is not None and folder.trajectory("odometry") is None:
            folder.write_trajectory("odometry", job.stream.tracked())
        if job.settings.output.report:
            write_report(folder)
