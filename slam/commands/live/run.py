"""A live run from start to end: a source in, poses out while it lasts, a run folder at its end."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from erfsfm.common.files import FolderLock
from erfsfm.common.signals import raising_on_termination
from slam.commands.live.reader import EXPECTED, StreamedSequence
from slam.commands.live.source import open_source
from slam.commands.run.recorder import FolderRecorder
from slam.commands.run.request import Request
from slam.commands.run.run import provenance_of, record
from slam.config.sections import load_config
from slam.formats.trajectory import Trajectory
from slam.frames import Intrinsics
from slam.frontend.drive import Drive
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.pipeline.estimate import Estimate
from slam.pipeline.live_poses import LivePose, LivePoses
from slam.pipeline.observer import Observer
from slam.pipeline.run import SlamPipeline
from slam.prediction.assembly import open_prediction
from slam.results.folder import RunFolder
from slam.results.output import check_output
from slam.results.run_log import run_log
from slam.runtime.errors import SlamError
from slam.runtime.imports import import_extra
from slam.sequences.camera_file import as_known, find_camera_file

logger = logging.getLogger(__name__)

Emit = Callable[[dict[str, Any]], None]
_EVERY = 6  # pixel of the depth map, and frame, whose points are shown
_PATH = (40, 110, 240)
_DROPPED = "; {} images were dropped, for they came faster than they were measured (--every-frame drops none)"


class LiveRequest(Request):
    """All inputs of a live run, as ``erfsfm-slam live --help`` says."""

    dataset: str
    every_frame: bool = False
    view: bool = False
    wait: float = 10.0


def run_live(request: LiveRequest, emit: Emit) -> RunFolder:
    """Track a stream until it ends, stalls, dies or is interrupted, then leave a whole run.

    The first ctrl-C, SIGTERM or SIGHUP ends the stream, another one the run.

    Args:
        request: all inputs.
        emit: called with every message.

    Raises:
        SlamError, ErfsfmError: one line; as ``slam.commands.run.run.run_slam``.
    """
    with run_log() as log, raising_on_termination() as ignore_signals, FolderLock() as lock:
        if request.output is not None:
            check_output(request.output)
        if request.view:
            import_extra("rerun")
        settings = load_config(request.config, request.overrides or ())
        source = open_source(request.dataset, request.wait)
        path = Path(request.dataset).absolute()
        folders = (path, path.parent) if path.exists() else ()
        camera = find_camera_file(request.camera, *folders, wanted_by=request.dataset, images=source, fps=source.fps)
        source.fps, name = camera.fps, Path(request.dataset).stem or "live"
        sequence = StreamedSequence(name, source, camera, request.wait, request.every_frame)
        sequence.intrinsics = as_known(sequence.intrinsics, request.camera)
        prediction = open_prediction(request.weights, request.device, settings.depth, sequence.intrinsics)
        pipeline = SlamPipeline(sequence, prediction.predictor, settings, seed=request.seed)
        pipeline.require_possible()
        blank = np.zeros((sequence.intrinsics.height, sequence.intrinsics.width, 3), np.uint8)
        prediction.networks.depth(blank)  # both are loaded before images come
        prediction.networks.poses([blank] * (prediction.networks.sources + 1))
        viewer = Viewer(sequence.intrinsics) if request.view else None
        folder = RunFolder.create(request.output, Path(settings.output.root), name, lock)
        recorder = LiveRecorder(folder, pipeline, settings, provenance_of(request, prediction, sequence))
        poses, reader = LivePoses(prediction.networks.sources, sequence.camera_height_m, settings), sequence.reader
        recorder.follow(sequence, poses, emit, viewer)
        try:
            # in a thread: the reader's lock may be held by the code that is interrupted
            record(recorder, log, ignore_signals, sequence.frames(), lambda: Thread(target=reader.stop).start())
        except SlamError as error:
            raise SlamError(f"{error}{_DROPPED.format(reader.dropped) if reader.dropped else ''}") from error
        finally:
            reader.close()
    return folder


class LiveRecorder(FolderRecorder):
    """Also says where the camera is while frames come, and how it ended."""

    def follow(self, sequence: StreamedSequence, poses: LivePoses, emit: Emit, viewer: Viewer | None) -> None:
        """Say the poses of a sequence that grows."""
        self._sequence, self._poses, self._emit, self._viewer = sequence, poses, emit, viewer
        self._said = 0
        self._dropped, self._dropped_said_s = 0, -math.inf

    def frame(self, observer: Observer) -> None:
        """Say the poses of frames that were finished since the last call."""
        reader = self._sequence.reader
        if not reader.is_waiting:
            observer.flush()
        self._say_dropped()
        for newest in self._poses.add(observer):
            index, self._said = self._said, self._said + 1
            arrival = self._sequence.arrivals.get(index)
            message = pose_message(index, float(self._sequence.stamps[index]), newest, self._poses.unit_name)
            late = None if arrival is None else round(1e3 * (time.monotonic() - arrival.at_s), 1)
            self._emit(message | {"latency_ms": late, "dropped": reader.dropped})
            if self._viewer is not None:
                self._viewer.show(index, observer.drive, newest)

    def estimate(self, estimate: Estimate) -> None:
        """Also say all poses again as the whole drive gives them, and why it ended."""
        super().estimate(estimate)
        reader, folder = self._sequence.reader, str(self.folder.path)
        message = corrected_message(estimate.optimised, len(estimate.loops.accepted), estimate.scale.unit_name, folder)
        self._emit(message | {"dropped": reader.dropped, "ended": reader.ended})
        if self._viewer is not None:
            self._viewer.correct(estimate.optimised)
        (logger.warning if reader.dropped else logger.info)("%d images were dropped", reader.dropped)
        (logger.info if reader.ended in EXPECTED else logger.warning)("the stream ended: %s", reader.ended)

    def leave(self) -> None:
        """The poses so far, which nothing else could give again."""
        if self.folder.trajectory("odometry") is None:
            T_world_camera = self._poses.T_world_camera
            stamps = self._sequence.stamps[: len(T_world_camera)]
            self.folder.write_trajectory("odometry", Trajectory(stamps, T_world_camera))

    def _say_dropped(self) -> None:
        """Once a second, while more images are dropped."""
        dropped, now_s = self._sequence.reader.dropped, time.monotonic()
        if dropped > self._dropped and now_s - self._dropped_said_s >= 1.0:
            self._dropped, self._dropped_said_s = dropped, now_s
            logger.warning("%d images dropped, %d measured", dropped, len(self._sequence))


class Viewer:
    """Opens the viewer; it is shown what the drive has while it lasts."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        """Start it; ``SlamError`` where rerun is not installed."""
        (self._rr,) = import_extra("rerun")
        self._intrinsics = intrinsics
        self._positions: list[FloatArray] = []
        self._stream = self._rr.RecordingStream("erfsfm-slam live")
        self._stream.spawn()
        self._stream.log("world", self._rr.ViewCoordinates.RDF, static=True)

    def show(self, index: int, drive: Drive, newest: LivePose) -> None:
        """A frame at its pose; its image and depth where it is a keyframe."""
        rr, stream, T = self._rr, self._stream, newest.T_world_camera
        stream.set_time("frame", sequence=index)
        self._positions.append(T[:3, 3])
        stream.log("world/path", rr.LineStrips3D([np.array(self._positions[-2000:])], colors=[_PATH]))
        stream.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        keyframe = drive.keyframes[-1] if drive.keyframes else None
        if keyframe is None or index - keyframe.index > 1 or newest.unit is None:
            return
        image, depth = keyframe.image, newest.unit * keyframe.depth_unscaled
        height, width = depth.shape
        camera = self._intrinsics.resized(width, height)
        pinhole = rr.Pinhole(image_from_camera=camera.K, width=width, height=height)
        stream.log("world/camera/image", pinhole, rr.Image(image).compress(jpeg_quality=85))
        stream.log("depth", rr.DepthImage(depth))
        if index % _EVERY == 0:
            grid = np.s_[height // 3 :: _EVERY, ::_EVERY]
            near = depth[grid] < np.nanmedian(depth) * 2
            points = (camera.rays(camera.pixel_grid()[grid]) * depth[grid][..., None])[near]
            cloud = rr.Points3D(se3.apply(T, points), colors=image[grid][near])
            stream.log(f"world/map/{index}", cloud)

    def correct(self, trajectory: Trajectory) -> None:
        """The path of the whole drive, with its loops closed."""
        self._stream.log("world/path", self._rr.LineStrips3D([trajectory.positions], colors=[(20, 160, 60)]))
        self._stream.flush()


def pose_message(index: int, stamp: float, newest: LivePose, unit: str | None) -> dict[str, Any]:
    """One frame: its pose ``(4, 4)`` as 12 numbers, row by row as in KITTI's files."""
    pose = [float(x) for x in newest.T_world_camera[:3].ravel()]
    support = None if newest.support is None else round(newest.support, 2)
    known = {"unit": unit, "scale": newest.unit, "support": support}
    return {"type": "pose", "frame": index, "stamp": stamp, "state": newest.state, **known, "T_world_camera": pose}


def corrected_message(trajectory: Trajectory, loops: int, unit: str | None, run: str) -> dict[str, Any]:
    """All poses after the whole drive was solved, with its loops closed."""
    poses = [[float(x) for x in T[:3].ravel()] for T in trajectory.T_world_camera]
    state = "loop closed" if loops else "whole drive"
    stamps = [float(stamp) for stamp in trajectory.stamps]
    content = {"type": "trajectory", "state": state, "loops": loops, "unit": unit, "run": run}
    return content | {"stamps": stamps, "T_world_camera": poses}
