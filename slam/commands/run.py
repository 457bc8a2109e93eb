"""One run from start to end: what ``run`` and `slam.run_slam` are given in, a run folder out."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypedDict, Unpack

from pydantic import BeforeValidator, Field, ValidationError

from erfsfm import __version__
from erfsfm.common.config_tree import Section, first_problem
from erfsfm.common.errors import explained, without_secrets
from erfsfm.common.files import FolderLock
from erfsfm.common.processes import limit_library_threads
from erfsfm.common.progress import Progress, progress_bar, progress_lines, silent
from erfsfm.common.readers.camera_file import CameraFile, is_auto
from erfsfm.common.signals import raising_on_termination
from erfsfm.inference import DepthPosePredictor, commit
from slam.config.sections import SlamConfig, dump_yaml, load_config
from slam.evaluation.map import double_wall_share
from slam.formats.ply import Ply
from slam.formats.trajectory import Trajectory
from slam.frames import Frame, Image, Mask, resized_mask
from slam.frames import Sequence as FrameSequence
from slam.frontend.fixed_mask import FixedMask
from slam.frontend.self_calibration import MOST_FRAMES, find_camera
from slam.mapping.depth import KeyframeDepth
from slam.pipeline.estimate import Estimate
from slam.pipeline.run import Recorder, SlamPipeline, look_ahead, read_frame
from slam.prediction.assembly import open_prediction
from slam.prediction.depth_source import DepthSource, FrameNumbers
from slam.results.estimate_metrics import estimate_metrics, lidar_trajectory, timing_of
from slam.results.folder import RunFolder, RunLog, check_output, run_log
from slam.results.metrics import MapMetrics, Metrics, Provenance
from slam.results.report.page import (
    DepthPictures,
    Picture,
    fixed_pictures,
    loop_pictures,
    write_report,
)
from slam.results.report.rerun import write_rerun
from slam.results.truth_errors import DepthQuality, map_errors
from slam.runtime.errors import (
    EmptyMapError,
    Failed,
    MissingCameraError,
    RunError,
    SlamError,
    attempt,
)
from slam.runtime.files import (
    CONFIG,
    GRAPH,
    LOG,
    LOOPS,
    MAP_CLOUD,
    MAP_MESH,
    PLACES,
    from_anywhere,
    source_from_anywhere,
)
from slam.runtime.imports import import_extra
from slam.sequences.camera_file import AUTO, write_camera
from slam.sequences.catalogue import open_sequence
from slam.sequences.gps_track import read_gps
from slam.sequences.recording import RecordedSequence
from slam.simulation.recording import open_or_embedded

logger = logging.getLogger(__name__)

NameOrPath = Annotated[
    str, BeforeValidator(lambda given: str(given) if isinstance(given, Path) else given)
]

_BEGUN = "the run has not ended, or was killed before its trajectories were written"
_NO_KEYFRAMES = "no frame for the map has depth"
_RECORDING = ("dataset", "camera", "gps", "sequence", "frames", "truth")


class Request(Section):
    """The inputs that every run has, as ``erfsfm-slam run --help`` explains them; from Python, a path may be text."""

    camera: Path | None = None
    weights: NameOrPath = "default"
    config: NameOrPath | None = None
    overrides: list[str] | None = None
    output: Path | None = None
    seed: int = Field(default=0, ge=0, lt=2**31)
    device: Literal["auto", "cpu", "cuda"] = "auto"
    command: str = "slam.run_slam"  # recorded in the metrics
    progress: Progress = silent  # called with (stage, done, total)

    @classmethod
    def of(cls, **arguments: Any) -> Self:
        """The request of arguments given by name.

        Raises:
            RunError: an unknown argument, or a value of another kind.
        """
        try:
            return cls(**arguments)
        except ValidationError as error:
            raise RunError(f"run_slam: {first_problem(error)}") from error

    @property
    def recording(self) -> dict[str, str]:
        """The options that name the recording, files by their whole paths; none of the embedded street."""
        found = {}
        for name in _RECORDING:
            value = getattr(self, name, None)
            if name == "dataset" or isinstance(value, Path):
                value = value and from_anywhere(value)
            if value is not None:
                found[name] = without_secrets(value)
        return found


class RunRequest(Request):
    """Also the recording and what is written of it; without ``dataset`` and ``sequence`` the embedded street."""

    dataset: Path | None = None
    sequence: str | None = None
    frames: str | None = None
    truth: Path | None = None
    rerun: Path | None = None
    gps: Path | None = None


class FolderRecorder(Recorder):
    """Writes results to a folder as they come, and ``metrics.json`` at the begin, with the estimate, and at the end."""

    def __init__(
        self,
        request: Request,
        pipeline: SlamPipeline,
        settings: SlamConfig,
        provenance: Provenance,
        lock: FolderLock,
    ) -> None:
        """Prepare to write what a pipeline gives, to a folder that is made."""
        results, name = Path(settings.output.root), pipeline.sequence.name
        self.folder = RunFolder.create(request.output, results, name, lock)
        self.pipeline, self._settings, self._progress = pipeline, settings, request.progress
        self._metrics = Metrics(schema_=1, status="running", reason=_BEGUN, provenance=provenance)

    def begin(self) -> None:
        """The metrics and settings of a run that begins; the source of depth by its whole path."""
        self.folder.write_metrics(self._metrics)
        self._write_camera(None)
        depth = self._settings.depth
        depth = depth.model_copy(update={"source": source_from_anywhere(depth.source)})
        self.folder.write(CONFIG, dump_yaml(self._settings.model_copy(update={"depth": depth})))

    def trajectory(self, name: str, trajectory: Trajectory) -> None:
        """On disk in both formats."""
        self.folder.write_trajectory(name, trajectory)

    def estimate(self, estimate: Estimate) -> None:
        """Trajectories by loops and graph, these, and places; all metrics but those of the map."""
        folder, sequence = self.folder, self.pipeline.sequence
        for name in ("odometry", "optimised"):
            folder.write_trajectory(name, getattr(estimate, name))
        lidar = lidar_trajectory(estimate)
        if lidar is not None:
            folder.write_trajectory("lidar", lidar)
        if not isinstance(estimate.graph, Failed):
            estimate.graph.write_g2o(folder.path / GRAPH)
        folder.write(LOOPS, json.dumps(estimate.loops.details(), indent=2, allow_nan=False))
        self._write_camera(estimate.drive.measured.fixed)
        folder.write(PLACES, estimate.places(sequence.intrinsics).write)
        with estimate.stopwatch.stage("evaluation"):
            self._metrics = estimate_metrics(
                estimate, sequence, self._metrics.provenance, self._settings.gps.factors
            )
        folder.write_metrics(self._metrics)
        self._stopwatch = estimate.stopwatch
        self._quality = DepthQuality(sequence, estimate.scale.is_metric)
        self._depths = DepthPictures(len(sequence))

    def _write_camera(self, fixed: Mask | None) -> None:
        """The camera for a next run, with what is ``fixed`` ``(h, w)`` to it, where no calibration says as much."""
        sequence = self.pipeline.sequence
        assert isinstance(sequence, RecordedSequence)
        camera = sequence.camera
        if not isinstance(camera, CameraFile) or (fixed is None and not camera.fx_sigma):
            return
        if fixed is not None:
            fixed, lens = resized_mask(fixed, camera.width, camera.height), sequence.undistortion
            fixed = fixed if lens is None else lens.as_stored(fixed)
        write_camera(self.folder.path, camera, fixed)

    def keyframe(self, keyframe: KeyframeDepth) -> None:
        """Compared with the truth, and drawn for the report."""
        self._depths.add(keyframe)
        with self._stopwatch.stage("evaluation"):
            self._quality.add(keyframe)

    def map(self, estimate: Estimate | Failed) -> None:
        """Merge the submaps, write mesh and cloud; without a map its metrics are the reason."""
        found = estimate if isinstance(estimate, Failed) else self._mapped(estimate)
        if isinstance(found, Failed):
            found = MapMetrics.unknown(found.reason)
        self._metrics = self._metrics.changed(map=found)

    def _mapped(self, estimate: Estimate) -> MapMetrics | Failed:
        """The metrics of mesh and cloud, which are written, or why there are none."""
        if estimate.map is None:
            is_enabled = self._settings.mapping.enabled
            return Failed(
                _NO_KEYFRAMES if is_enabled else "fusion is switched off (mapping.enabled)"
            )
        try:
            with self._stopwatch.stage("mesh"):
                surface = estimate.map.surface(self._progress)
                self._progress("map files", 0, 1)
                surface.write_mesh(self.folder.path / MAP_MESH)
                surface.write_cloud(self.folder.path / MAP_CLOUD)
        except EmptyMapError as error:
            logger.warning("no map: %s", error)
            return Failed(str(error))
        with self._stopwatch.stage("evaluation"):
            metric = estimate.scale.is_metric
            share = (
                double_wall_share(surface.meshes())
                if metric
                else Failed("lengths are not in metres")
            )
            pieces = lambda: (Ply(piece).points for piece in surface.cloud_pieces())  # noqa: E731
            errors = map_errors(pieces, estimate, self.pipeline.sequence)
        self._progress("map files", 1, 1)
        return MapMetrics.of(**estimate.map.statistics(), double_wall_share=share, **errors)

    def finish(self, estimate: Estimate) -> None:
        """The report and all metrics of a whole run."""
        depth = self._quality.metrics(self._settings.depth.refine != "none")
        timing = timing_of(self._stopwatch, len(self.pipeline.sequence))
        metrics = self._metrics.changed(status="ok", reason=None, timing=timing, depth=depth)

        def reported() -> None:
            if self._settings.output.report:
                from slam.results.report.figures import map_view  # with Plotly

                drive, fixed = estimate.drive, []
                if drive.measured.fixed is not None and drive.keyframes:
                    image = drive.keyframes[len(drive.keyframes) // 2].image
                    fixed = fixed_pictures(image, drive.measured.fixed)
                pictures = self._depths.pictures(), self._loop_pictures(estimate)
                write_report(self.folder, *pictures, map_view(self.folder), metrics, fixed)

        self._progress("report", 0, 1)
        attempt("the report", reported)
        self.folder.write_metrics(metrics)
        self._progress("report", 1, 1)

    def fail(self, error: BaseException) -> str:
        """Write the reason of a failure, which is returned; errors of writing are ignored, for the first is raised."""
        reason = (
            explained(error) if isinstance(error, Exception) else str(error) or type(error).__name__
        )
        with suppress(SlamError, OSError):
            self.folder.write_metrics(self._metrics.changed(status="failed", reason=reason))
            self.leave()
            if self._settings.output.report:
                write_report(self.folder)
        return reason

    def leave(self) -> None:
        """What a run that failed can give yet."""

    def _loop_pictures(self, estimate: Estimate) -> list[Picture]:
        """Images of accepted loops: of the recording, or of the keyframes of a live drive."""
        sequence = self.pipeline.sequence

        def image(index: int) -> Image | None:
            try:
                return sequence.frame(index).image
            except SlamError:
                return next(
                    (each.image for each in estimate.drive.keyframes if each.index == index), None
                )

        return loop_pictures(estimate.loops.accepted, image, sequence.intrinsics)


class RunOptions(TypedDict, total=False):
    """The options of ``erfsfm-slam run`` from Python, for mypy and editors; `RunRequest` has their defaults."""

    camera: str | Path | None
    weights: str | Path
    config: str | Path | None
    overrides: Sequence[str] | None
    frames: str | None
    truth: str | Path | None
    gps: str | Path | None
    output: str | Path | None
    rerun: str | Path | None
    seed: int
    device: Literal["auto", "cpu", "cuda"]
    progress: Progress


def run_slam(
    dataset: str | Path | None = None, sequence: str | None = None, **options: Unpack[RunOptions]
) -> RunFolder:
    """Run the whole system on one sequence; the arguments are the options of ``erfsfm-slam run``.

    Without ``progress``, the log says every ten seconds (level INFO) what is done; in a notebook its cell does.

    Raises:
        SlamError, ErfsfmError: as `perform`.
    """
    in_notebook = "ipykernel" in sys.modules
    shown = progress_bar() if in_notebook else progress_lines(logger.info)
    with nullcontext(options["progress"]) if "progress" in options else shown as progress:
        given = {**options, "progress": progress}
        return perform(RunRequest.of(dataset=dataset, sequence=sequence, **given))


def perform(request: RunRequest) -> RunFolder:
    """Run the whole system on one sequence.

    All checks come before a folder is made; an earlier run in ``output`` is removed then. The first signal to end
    during the pass over the frames ends the pass: what was seen is a whole run.

    Raises:
        SlamError, ErfsfmError: one line. However a run ends, its folder keeps its results and the reason.
    """
    with run_log() as log, raising_on_termination() as ignore_signals, FolderLock() as lock:
        if request.output is not None:
            check_output(request.output)
        if request.rerun is not None:
            import_extra("rerun")
        settings = load_config(request.config, request.overrides or ())
        recording = open_recording(request)
        lens, camera = recording.undistortion, recording.intrinsics
        # by which files of depth are found
        numbers = FrameNumbers(len(recording), recording.start, recording.recorded)
        undistort = None if lens is None else lens.apply_to_depth
        predictor, networks, source = open_prediction(
            request.weights, request.device, settings.depth, camera, numbers, undistort
        )
        track = None if request.gps is None else read_gps(request.gps)
        pipeline = SlamPipeline(
            recording, predictor, settings, request.progress, request.seed, track
        )
        pipeline.require_possible()
        provenance = provenance_of(request, recording, networks, source)
        recorder = FolderRecorder(request, pipeline, settings, provenance, lock)
        estimate = record(recorder, log, ignore_signals)
        if request.rerun is not None:
            write_rerun(request.rerun, estimate, pipeline.sequence.intrinsics)
    return recorder.folder


def open_recording(request: RunRequest) -> RecordedSequence:
    """The recording; a camera that nobody states is found by its own images, and said in one line.

    Raises:
        SequenceError: as `open_or_embedded`.
    """
    asked, place = request.camera, (request.dataset, request.sequence)
    try:
        recording = open_or_embedded(*place, asked, request.frames, request.truth)
    except MissingCameraError:
        asked = AUTO
        recording = open_sequence(*place, asked, request.frames, request.truth)
    camera = recording.camera
    if asked is None or not is_auto(asked) or not isinstance(camera, CameraFile):
        return recording
    total, fixed = min(len(recording), MOST_FRAMES), FixedMask()
    look_ahead(recording, fixed)
    recording.fixed = fixed.mask

    def frames() -> Iterator[Frame]:
        for index in range(total):
            request.progress("camera", index + 1, total)
            frame = read_frame(recording, index)
            if isinstance(frame, Frame):
                yield frame

    found = find_camera(frames())
    said = found.sentence(camera.width)
    logger.warning("%s", said)
    recording.take_camera(found.as_file(camera, said), recording.camera_height_m)
    return recording


def record(
    recorder: FolderRecorder,
    log: RunLog,
    ignore_signals: Callable[[], None],
    frames: Iterator[Frame] | None = None,
    interrupt: Callable[[], None] | None = None,
) -> Estimate:
    """Run to the end; however that is, the folder keeps the results and the reason.

    The first signal to end during the pass over the frames calls ``interrupt``, by default that of the pipeline.
    """
    try:
        recorder.begin()
        log.begin(recorder.folder.path / LOG)
        with limit_library_threads():
            estimate = recorder.pipeline.run(recorder, frames, interrupt)
        recorder.finish(estimate)
        return estimate
    except BaseException as error:
        ignore_signals()
        log.failed(recorder.fail(error))
        raise


def provenance_of(
    request: Request,
    recording: FrameSequence,
    networks: DepthPosePredictor,
    source: DepthSource | None,
) -> Provenance:
    """The input of a run: networks, another source of depth, and the options that name the recording."""
    # else a shipped name, whatever lies here
    is_folder = Path(request.weights) == Path(networks.origin)
    return Provenance(
        version=__version__,
        commit=commit(),
        command=without_secrets(request.command),
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
