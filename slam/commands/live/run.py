"""A live run from start to end: a source in, poses out while it lasts, a run folder at its end."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread

import numpy as np

from erfsfm.common.lock import FolderLock
from erfsfm.common.signals import calling_on_signals, raising_on_termination
from erfsfm.inference import DepthPosePredictor
from slam.commands.live.messages import Emit, corrected_message, pose_message
from slam.commands.live.reader import EXPECTED
from slam.commands.live.request import LiveRequest
from slam.commands.live.sequence import StreamedSequence, calibration_of
from slam.commands.live.source import open_source
from slam.commands.live.view import Viewer
from slam.commands.run.job import Job, Stream, complete
from slam.commands.run.request import RunRequest
from slam.commands.run.run import provenance_of
from slam.config.sections import load_config
from slam.formats.trajectory import Trajectory
from slam.pipeline.batch import SlamPipeline
from slam.pipeline.estimate import Estimate
from slam.pipeline.input_checks import require_possible
from slam.pipeline.live_poses import LivePoses
from slam.pipeline.observer import Observer
from slam.prediction.assembly import make_predictor, open_depth
from slam.results.folder import RunFolder
from slam.results.output_folder import check_output
from slam.results.run_log import run_log
from slam.runtime.errors import SlamError
from slam.runtime.imports import import_extra
from slam.sequences.camera_file import as_known
from slam.sequences.recording import GrowingSequence
from slam.sequences.undistortion import intrinsics_of

logger = logging.getLogger(__name__)


def run_live(request: LiveRequest, emit: Emit) -> RunFolder:
    """Track a stream until it ends, stalls, dies or is interrupted, then leave a whole run.

    Args:
        request: all inputs.
        emit: called with every message.

    Raises:
        SlamError, ErfsfmError: one line; as ``slam.commands.run.run.run_slam``.
    """
    with run_log() as log, raising_on_termination() as ignore_signals:
        job, sequence = _prepare(request, emit)
        with _stopping(sequence), FolderLock() as lock:
            folder = RunFolder.create(request.output, Path(job.settings.output.root), sequence.name, lock)
            try:
                return complete(job, folder, log, ignore_signals)
            except SlamError as error:
                dropped = sequence.reader.dropped
                raise SlamError(f"{error}{_DROPPED.format(dropped) if dropped else ''}") from error


def _prepare(request: LiveRequest, emit: Emit) -> tuple[Job, StreamedSequence]:
    """Open and check all inputs; the source is read from here on."""
    if request.output is not None:
        check_output(request.output)
    if request.view:
        import_extra("rerun")
    settings = load_config(request.config, request.overrides or ())
    networks = DepthPosePredictor.from_weights(request.weights, request.device, "onnx")
    source = open_source(request.source, request.wait)
    camera = calibration_of(request.source, request.camera_file, source)
    source.fps = camera.fps
    intrinsics = intrinsics_of(camera)
    depth = open_depth(settings.depth, intrinsics, None)
    predictor = make_predictor(networks, depth, settings.depth, intrinsics)
    name = Path(request.source).stem or "live"
    growing = GrowingSequence(intrinsics, camera.height_or(None), name=name)
    require_possible(growing, settings, predictor.sources + 1)
    blank = np.zeros((intrinsics.height, intrinsics.width, 3), np.uint8)
    networks.depth(blank)  # both are loaded before images come
    networks.poses([blank] * (networks.sources + 1))
    sequence = StreamedSequence(name, source, camera, request.wait, request.every_frame)
    sequence.intrinsics = as_known(sequence.intrinsics, request.camera_file)
    pipeline = SlamPipeline(sequence, predictor, settings, seed=request.seed)
    poses = LivePoses(predictor.sources, sequence.camera_height_m, settings)
    session = _Session(sequence, poses, emit, Viewer(intrinsics) if request.view else None)
    recorded = RunRequest(
        dataset=Path(request.source),
        camera=request.camera_file,
        weights=request.weights,
        output=request.output,
        seed=request.seed,
        command=request.command,
    )
    provenance = provenance_of(recorded, networks, sequence, depth)
    stream = Stream(sequence.frames, session.watch, session.finish, session.tracked)
    return Job(settings, sequence, pipeline, provenance, stream=stream), sequence


_DROPPED = "; {} images were dropped, for they came faster than they were measured (--every-frame drops none)"


class _Session:
    """Says where the camera is while frames come, and how it ended."""

    def __init__(self, sequence: StreamedSequence, poses: LivePoses, emit: Emit, viewer: Viewer | None) -> None:
        self._sequence, self._poses, self._emit, self._viewer = sequence, poses, emit, viewer
        self._said = 0
        self._dropped, self._dropped_said_s = 0, -math.inf

    def watch(self, observer: Observer) -> None:
        """Say the poses of frames that were finished since the last call."""
        if not self._sequence.reader.is_waiting:
            observer.flush()
        self._say_dropped()
        for newest in self._poses.add(observer):
            index, self._said = self._said, self._said + 1
            arrival = self._sequence.arrivals.get(index)
            message = pose_message(index, float(self._sequence.stamps[index]), newest, self._poses.unit_name)
            late = None if arrival is None else round(1e3 * (time.monotonic() - arrival.at_s), 1)
            self._emit(message | {"latency_ms": late, "dropped": self._sequence.reader.dropped})
            if self._viewer is not None:
                self._viewer.show(index, observer.drive, newest)

    def _say_dropped(self) -> None:
        """Once a second, while more images are dropped."""
        dropped, now_s = self._sequence.reader.dropped, time.monotonic()
        if dropped > self._dropped and now_s - self._dropped_said_s >= 1.0:
            self._dropped, self._dropped_said_s = dropped, now_s
            logger.warning("%d images dropped, %d measured", dropped, len(self._sequence))

    def tracked(self) -> Trajectory:
        """The poses that were said so far."""
        T_world_camera = self._poses.T_world_camera
        return Trajectory(self._sequence.stamps[: len(T_world_camera)], T_world_camera)

    def finish(self, result: Estimate, folder: Path) -> None:
        """Say all poses again as the whole drive gives them, and why it ended."""
        reader = self._sequence.reader
        message = corrected_message(result.optimised, len(result.loops.accepted), result.scale.unit_name, str(folder))
        self._emit(message | {"dropped": reader.dropped, "ended": reader.ended})
        if self._viewer is not None:
            self._viewer.correct(result.optimised)
        (logger.warning if reader.dropped else logger.info)("%d images were dropped", reader.dropped)
        (logger.info if reader.ended in EXPECTED else logger.warning)("the stream ended: %s", reader.ended)


@contextmanager
def _stopping(sequence: StreamedSequence) -> Iterator[None]:
    """The first ctrl-C, SIGTERM or SIGHUP ends the stream, a second ctrl-C the run; its reader ends with the block."""

    def stop(*_: object) -> None:
        Thread(target=sequence.reader.stop).start()  # its lock may be held by the code that was interrupted

    try:
        with calling_on_signals(stop):
            yield
    finally:
        sequence.reader.close()
