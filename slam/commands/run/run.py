"""One run from start to end: what ``run`` and `slam.run_slam` are given in, a run folder out."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, ValidationError

from erfsfm import __version__
from erfsfm.common.config_tree import Section, first_problem
from erfsfm.common.files import FolderLock
from erfsfm.common.progress import Progress, progress_bar, progress_lines, silent
from erfsfm.common.signals import raising_on_termination
from erfsfm.common.threads import limit_library_threads
from erfsfm.inference import commit
from slam.commands.run.recorder import FolderRecorder
from slam.config.sections import load_config
from slam.frames import Frame
from slam.frames import Sequence as FrameSequence
from slam.pipeline.estimate import Estimate
from slam.pipeline.run import SlamPipeline
from slam.prediction.assembly import Prediction, open_prediction
from slam.prediction.depth_folder import FrameNumbers
from slam.results.folder import RunFolder, check_output
from slam.results.metrics import Provenance
from slam.results.report.rerun import write_rerun
from slam.results.run_log import RunLog, run_log
from slam.runtime.errors import RunError
from slam.runtime.imports import import_extra
from slam.runtime.run_files import LOG
from slam.runtime.storage.files import from_anywhere
from slam.sequences.catalogue import open_sequence
from slam.sequences.gps import read_gps

logger = logging.getLogger(__name__)

NameOrPath = Annotated[str, BeforeValidator(lambda given: str(given) if isinstance(given, Path) else given)]

_RECORDING = ("dataset", "camera", "gps", "sequence", "frames", "truth")


class Request(Section):
    """The inputs that every run has, as ``erfsfm-slam run --help`` explains them; from Python, a path may be text.

    Attributes:
        command: recorded in the metrics.
    """

    camera: Path | None = None
    weights: NameOrPath = "default"
    config: NameOrPath | None = None
    overrides: list[str] | None = None
    output: Path | None = None
    seed: int = Field(default=0, ge=0, lt=2**31)
    device: Literal["auto", "cpu", "cuda"] = "auto"
    command: str = "slam.run_slam"

    @classmethod
    def of(cls, **arguments: Any) -> Self:
        """The request of arguments given by name.

        Raises:
            TypeError: an unknown argument.
            RunError: a value of another kind.
        """
        if unknown := arguments.keys() - cls.model_fields.keys():
            names = ", ".join(name for name in cls.model_fields if name != "command")
            raise TypeError(f"run_slam has no argument {', '.join(sorted(unknown))}; it has {names}")
        try:
            return cls(**arguments)
        except ValidationError as error:
            raise RunError(f"run_slam: {first_problem(error)}") from error

    @property
    def recording(self) -> dict[str, str]:
        """The options that name the recording, files by their whole paths; none of the embedded street."""
        given = {name: getattr(self, name, None) for name in _RECORDING}
        named = {name: value for name, value in given.items() if value is not None}
        return {name: from_anywhere(v) if name == "dataset" or isinstance(v, Path) else v for name, v in named.items()}


class RunRequest(Request):
    """Also the recording and what is written of it; without ``dataset`` and ``sequence`` the embedded street.

    Attributes:
        progress: called with (stage, done, total).
    """

    dataset: Path | None = None
    sequence: str | None = None
    frames: str | None = None
    truth: Path | None = None
    rerun: Path | None = None
    gps: Path | None = None
    progress: Progress = silent


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
    if options.get("progress") is not None:
        return perform(RunRequest.of(dataset=dataset, sequence=sequence, **options))
    in_notebook = "ipykernel" in sys.modules
    with progress_bar() if in_notebook else progress_lines(logger.info) as progress:
        return perform(RunRequest.of(dataset=dataset, sequence=sequence, **options | {"progress": progress}))


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
        recording = open_sequence(request.dataset, request.sequence, request.camera, request.frames, request.truth)
        lens, camera = recording.undistortion, recording.intrinsics
        numbers = FrameNumbers(len(recording), recording.start, recording.recorded)  # by which files of depth are found
        undistort = None if lens is None else lens.apply_to_depth
        prediction = open_prediction(request.weights, request.device, settings.depth, camera, numbers, undistort)
        track = None if request.gps is None else read_gps(request.gps)
        progress = request.progress
        pipeline = SlamPipeline(recording, prediction.predictor, settings, progress, request.seed, track)
        pipeline.require_possible()
        folder = RunFolder.create(request.output, Path(settings.output.root), recording.name, lock)
        recorder = FolderRecorder(folder, pipeline, settings, provenance_of(request, prediction, recording), progress)
        estimate = record(recorder, log, ignore_signals)
        if request.rerun is not None:
            write_rerun(request.rerun, estimate, pipeline.sequence.intrinsics)
    return folder


def record(
    recorder: FolderRecorder,
    log: RunLog,
    ignore_signals: Callable[[], None],
    frames: Iterator[Frame] | None = None,
    interrupt: Callable[[], None] | None = None,
) -> Estimate:
    """Run to the end; however that is, the folder keeps the results and the reason.

    The first signal to end during the pass over the frames calls ``interrupt``, by default that of the pipeline.

    Raises:
        SlamError, ErfsfmError: one line.
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


def provenance_of(request: Request, prediction: Prediction, recording: FrameSequence) -> Provenance:
    """The input of a run: networks, depth, and the options that name the recording."""
    networks, source = prediction.networks, prediction.source
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
