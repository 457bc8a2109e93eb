"""A live run: frames of a source as they come, poses out while it lasts, a run folder at its end."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from erfsfm.common.errors import without_secrets
from erfsfm.common.files import FolderLock
from erfsfm.common.signals import raising_on_termination
from slam.commands.run import FolderRecorder, Request, provenance_of, record
from slam.config.sections import load_config
from slam.formats.trajectory import Trajectory
from slam.pipeline.estimate import Estimate
from slam.pipeline.live import LivePoses
from slam.pipeline.observer import Observer
from slam.pipeline.run import SlamPipeline
from slam.prediction.assembly import open_prediction
from slam.results.folder import RunFolder, check_output, run_log
from slam.results.report.rerun import Viewer
from slam.runtime.errors import SlamError
from slam.runtime.imports import import_extra
from slam.sequences.camera_file import find_camera_file, require_stated
from slam.sequences.stream import INTERRUPTED, OVER, StreamedSequence, open_source

logger = logging.getLogger(__name__)

Emit = Callable[[dict[str, Any]], None]
_DROPPED = "; {} images were dropped, for they came faster than they were measured (--every-frame drops none)"


class LiveRequest(Request):
    """All inputs of a live run, as ``erfsfm-slam live --help`` says."""

    dataset: str
    every_frame: bool = False
    view: bool = False
    wait: float = 10.0


def run_live(request: LiveRequest, emit: Emit) -> RunFolder:
    """Track a stream until it ends, stalls, dies or is interrupted, then leave a whole run.

    Every message goes to ``emit``. The first ctrl-C, SIGTERM or SIGHUP ends the stream, another one the run.

    Raises:
        SlamError, ErfsfmError: one line; as ``slam.commands.run.run_slam``.
    """
    with run_log() as log, raising_on_termination() as ignore_signals, FolderLock() as lock:
        if request.output is not None:
            check_output(request.output)
        if request.view:
            import_extra("rerun")
        settings = load_config(request.config, request.overrides or ())
        require_stated(request.camera)
        source = open_source(request.dataset, request.wait)
        path = Path(request.dataset).absolute()
        folders = (path, path.parent) if path.exists() else ()
        camera = find_camera_file(
            request.camera, *folders, wanted_by=request.dataset, images=source, fps=source.fps
        )
        source.fps, name = camera.fps, Path(without_secrets(request.dataset)).stem or "live"
        sequence = StreamedSequence(name, source, camera, request.wait, request.every_frame)
        predictor, networks, depth = open_prediction(
            request.weights, request.device, settings.depth, sequence.intrinsics
        )
        pipeline = SlamPipeline(sequence, predictor, settings, seed=request.seed)
        pipeline.require_possible()
        blank = np.zeros((sequence.intrinsics.height, sequence.intrinsics.width, 3), np.uint8)
        networks.depth(blank)  # both are loaded before images come
        networks.poses([blank] * (networks.sources + 1))
        viewer = Viewer(sequence.intrinsics) if request.view else None
        provenance = provenance_of(request, sequence, networks, depth)
        recorder = LiveRecorder(request, pipeline, settings, provenance, lock)
        poses = LivePoses(networks.sources, pipeline.unit)
        recorder.follow(sequence, poses, emit, viewer)
        try:
            # in a thread: the sequence's lock may be held by the code that is interrupted
            record(
                recorder,
                log,
                ignore_signals,
                sequence.frames(),
                lambda: Thread(target=sequence.stop).start(),
            )
        except SlamError as error:
            raise SlamError(
                f"{error}{_DROPPED.format(sequence.dropped) if sequence.dropped else ''}"
            ) from error
        finally:
            sequence.close()
    return recorder.folder


class LiveRecorder(FolderRecorder):
    """Also says where the camera is while frames come, and how it ended."""

    def follow(
        self, sequence: StreamedSequence, poses: LivePoses, emit: Emit, viewer: Viewer | None
    ) -> None:
        """Say the poses of a sequence that grows."""
        self._sequence, self._poses, self._emit, self._viewer = sequence, poses, emit, viewer
        self._said = 0
        self._dropped, self._dropped_said_s = 0, -math.inf

    def frame(self, observer: Observer) -> None:
        """Say the poses of frames that were finished since the last call."""
        sequence = self._sequence
        if not sequence.waiting:
            observer.flush()
        dropped, now_s = sequence.dropped, time.monotonic()
        if dropped > self._dropped and now_s - self._dropped_said_s >= 1.0:  # once a second
            self._dropped, self._dropped_said_s = dropped, now_s
            logger.warning("%d images dropped, %d measured", dropped, len(sequence))
        for newest in self._poses.add(observer):
            index, self._said = self._said, self._said + 1
            support = None if newest.support is None else round(newest.support, 2)
            late_s = time.monotonic() - sequence.arrived_s[index]
            message = {
                "type": "pose",
                "frame": index,
                "stamp": float(sequence.stamps[index]),
                "state": newest.state,
                "unit": self._poses.unit_name,
                "scale": newest.unit,
                "support": support,
                # row by row as in KITTI's files
                "T_world_camera": newest.T_world_camera[:3].ravel().tolist(),
                "latency_ms": round(1e3 * late_s, 1),
                "dropped": sequence.dropped,
            }
            self._emit(message)
            if self._viewer is not None:
                self._viewer.show(index, observer.measured, newest)

    def estimate(self, estimate: Estimate) -> None:
        """Also say all poses again as the whole drive gives them, and why it ended."""
        super().estimate(estimate)
        sequence, trajectory = self._sequence, estimate.optimised
        loops = len(estimate.loops.accepted)
        message = {
            "type": "trajectory",
            "state": "loop closed" if loops else "whole drive",
            "loops": loops,
            "unit": estimate.scale.unit_name,
            "run": str(self.folder.path),
            "stamps": trajectory.stamps.tolist(),
            "T_world_camera": trajectory.T_world_camera[:, :3].reshape(-1, 12).tolist(),
            "dropped": sequence.dropped,
            "ended": sequence.ended,
        }
        self._emit(message)
        if self._viewer is not None:
            self._viewer.correct(trajectory)
        (logger.warning if sequence.dropped else logger.info)(
            "%d images were dropped", sequence.dropped
        )
        is_expected = sequence.ended in (INTERRUPTED, OVER)
        (logger.info if is_expected else logger.warning)("the stream ended: %s", sequence.ended)

    def leave(self) -> None:
        """The poses so far, which nothing else could give again."""
        if self.folder.trajectory("odometry") is None:
            T_world_camera = self._poses.T_world_camera
            stamps = self._sequence.stamps[: len(T_world_camera)]
            self.folder.write_trajectory("odometry", Trajectory(stamps, T_world_camera))
