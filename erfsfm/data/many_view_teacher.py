"""The many-view teacher of whole drives: poses once a drive, then a label for every few frames.

The SLAM system gives the poses. All of it is kept in a folder under a digest of the drive's images and
camera, so that it is computed once. In a prepared folder a label is a small picture
(`erfsfm.data.label_file`). The networks' package does not import the SLAM system: what goes between
them are folders of images with their camera, and a trajectory.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from erfsfm.common.errors import DataError, TrainingError
from erfsfm.common.files import FolderLock, write_atomically
from erfsfm.common.processes import limit_library_threads, processes, slam_process
from erfsfm.common.progress import Progress
from erfsfm.common.readers.camera_file import CAMERA_FILE, read_camera_file
from erfsfm.common.readers.video import VideoFrames
from erfsfm.data.label_file import decode
from erfsfm.data.recordings import Recording
from erfsfm.data.window import ArrayCache, TeacherStructure, snippet_motion
from erfsfm.geometry import Camera
from erfsfm.labels.flow_labels import NEIGHBOURS, label, measure
from erfsfm.labels.refined_labels import in_camera_heights, refined_label, shrunk
from erfsfm.mvs.views import Grey, neighbours_around

logger = logging.getLogger(__name__)

VERSION = 4
# pixels of the images that flow alone measures: finer flow is slower and no surer; twice the networks' width would
# shift labels, sampled by nearest, by half a pixel
LARGEST_WIDTH = 800
FINER = 2  # learned depth is refined at this many times the labels' size, where images have as many pixels
LEAST_NEIGHBOURS = 2
_FPS = 10.0
_CAMERA_HEIGHT_M = 1.65  # any: poses are given in camera heights
_TRAJECTORY = "trajectory_optimised.kitti.txt"
_RUN = "--device cpu --set mapping.enabled=false --set output.report=false"
_CHUNK = 8  # labels of one task
_DIGITS = 32  # of a digest

Bounds = tuple[NDArray[np.float32], NDArray[np.float32]]  # least and most inverse depth (H, W)
Learned = Callable[
    [NDArray[np.uint8]], NDArray[np.float32]
]  # inverse depth (H, W) in any unit, of an RGB image


@dataclass(frozen=True)
class DriveLabels:
    """Poses and labels of one drive under ``folder``; labels have the networks' ``size`` (height, width).

    In a prepared folder labels are ``compact``. There the recording may be a part, of which the frames before its first
    are ``skipped``.
    """

    recording: Recording
    folder: Path
    size: tuple[int, int]
    stride: int
    compact: bool = False
    skipped: int = 0

    def targets(self, sources: int) -> range:
        """Frames with a label that have half of ``sources`` on either side, counted from the recording's first."""
        half = sources // 2
        return range(
            half + -(self.skipped + half) % self.stride, len(self.recording) - half, self.stride
        )

    @cached_property
    def T_world_camera(self) -> NDArray[np.float64]:
        """Poses ``(N, 4, 4)`` in camera heights."""
        poses = np.load(self.poses_file, allow_pickle=False)
        return poses[self.skipped : self.skipped + len(self.recording)]

    @property
    def poses_file(self) -> Path:
        """Poses of all frames."""
        return self.folder / "poses.npy"

    @property
    def weights_file(self) -> Path:
        """Name of the weights that gave the poses."""
        return self.folder / "slam_weights.txt"

    def label_file(self, target: int) -> Path:
        """Least and most inverse depth of one frame."""
        name = f"{self.skipped + target:06d}{'.webp' if self.compact else '.npz'}"
        return self.folder / f"{self.size[1]}x{self.size[0]}" / name

    def label(self, target: int) -> tuple[NDArray[np.float16], NDArray[np.float16]]:
        """Least and most inverse depth ``(H, W)`` of a frame.

        Raises:
            TrainingError: its file is missing or damaged.
        """
        path = self.label_file(target)
        try:
            if self.compact:
                return decode(path.read_bytes())
            with np.load(path, allow_pickle=False) as entry:
                return entry["least"], entry["most"]
        except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise TrainingError(
                f"the teacher's label {path} is damaged: delete it, start again ({error})"
            ) from error

    def measure_poses(self, weights: str) -> None:
        """Run the SLAM system on the drive and keep its poses.

        Args:
            weights: of the networks that the SLAM system uses.

        Raises:
            TrainingError: no trajectory, or one whose scale is not that of the camera's height.
        """
        recording, name = self.recording, self.recording.frames_name
        with tempfile.TemporaryDirectory(prefix="erfsfm-teacher-") as temporary:
            drive, output = Path(temporary) / "drive", Path(temporary) / "run"
            drive.mkdir()
            if recording.video is None:
                for index, path in enumerate(recording.images):
                    (drive / f"{index:06d}{path.suffix}").symlink_to(path.resolve())
            else:  # in order and at full size, which `Video` is not made for
                frames = VideoFrames(recording.video.path, counted_frames=0)
                for index in range(len(recording)):
                    cv2.imwrite(
                        str(drive / f"{index:06d}.png"),
                        frames.read(recording.number(index))[..., ::-1],
                    )
            camera = asdict(recording.camera) | {"fps": _FPS, "camera_height_m": _CAMERA_HEIGHT_M}
            (drive / "camera.yaml").write_text(yaml.safe_dump(camera))
            words = ["run", "--dataset", str(drive), "--output", str(output), "--weights", weights]
            if reason := slam_process(words + _RUN.split()):
                raise TrainingError(f"the teacher's poses of {name} could not be found: {reason}")
            rows = np.loadtxt(output / _TRAJECTORY).reshape(-1, 3, 4)
            unit = json.loads((output / "metrics.json").read_text())["scale"]["unit"]
        if unit != "metres":
            raise TrainingError(
                f"the teacher's poses of {name} have no scale: no road was found (lengths in {unit})"
            )
        T_world_camera = np.tile(np.eye(4), (len(rows), 1, 1))
        T_world_camera[:, :3] = rows
        T_world_camera[:, :3, 3] /= _CAMERA_HEIGHT_M
        write_atomically(self.weights_file, weights)
        self.keep_poses(T_world_camera)

    def require_weights(self, weights: str) -> None:
        """Refuse poses by other weights.

        Raises:
            TrainingError: the poses that are kept are by others.
        """
        both = self.poses_file.is_file() and self.weights_file.is_file()
        known = self.weights_file.read_text() if both else weights
        if known != weights:
            raise TrainingError(
                f"{self.folder} keeps poses of {self.recording.frames_name} by the weights '{known}', and those by "
                f"'{weights}' are wanted: name another folder for the measurements, or the same weights"
            )

    def keep_poses(self, T_world_camera: NDArray[np.float64]) -> None:
        """Write the poses ``(N, 4, 4)`` of all frames."""
        write_atomically(self.poses_file, partial(np.save, arr=T_world_camera))

    def measure_labels(self, targets: Sequence[int], learned: Learned | None = None) -> int:
        """Measure and keep the labels of some frames; returns their number.

        They are learned depth refined by neighbours, or what flow measures alone where no depth is learned. Neighbours
        that cannot be read are left out. Of a frame that cannot be read, or has less than two, nothing is known.
        """
        cv2.setNumThreads(1)
        for target in targets:
            bounds = self._bounds(target, learned)
            if bounds is None:
                bounds = np.zeros(self.size, np.float32), np.full(self.size, np.inf, np.float32)
            arrays = {}
            for name, values in zip(("least", "most"), bounds):
                resized = cv2.resize(values, self.size[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
                arrays[name] = resized.astype(np.float16)
            write_atomically(
                self.label_file(target), partial(np.savez_compressed, **arrays), sync=False
            )
        return len(targets)

    def _bounds(self, target: int, learned: Learned | None) -> Bounds | None:
        """Label of a frame by flow, at a size at which that is fine, or around its learned depth in finer images."""
        camera, (height, width) = self.recording.camera, self.size
        if learned is None:
            ratio = min(LARGEST_WIDTH / camera.width, 1)
            camera = camera.resized(round(camera.width * ratio), round(camera.height * ratio))
        else:
            finer = FINER if camera.width > 1.5 * width else 1
            camera = camera.resized(finer * width, finer * height)
        before_and_after = [target + k for k in NEIGHBOURS if 0 <= target + k < len(self.recording)]
        image, around = self._image(target, camera), self._greys(before_and_after, camera)
        if image is None or len(around) < LEAST_NEIGHBOURS:
            return None
        grey, K, motion = _grey(image), camera.K.astype(np.float64), self._motion(target, around)
        if learned is None:
            return label(grey, [*around.values()], K, motion)
        inverse_depth = in_camera_heights(
            learned(image), *measure(grey, [*around.values()], K, motion)
        )
        if inverse_depth is None:
            return None
        frames = np.arange(len(self.recording))
        chosen = neighbours_around(
            self.T_world_camera, target, 1 / float(np.median(inverse_depth)), frames
        )
        known = around | self._greys([n for n in chosen if n not in around], camera)
        others = {n: known[n] for n in chosen if n in known}
        if not others:
            return None
        return shrunk(
            *refined_label(
                grey, [*others.values()], K, self._motion(target, others), inverse_depth
            ),
            finer,
        )

    def _greys(self, frames: Iterable[int], camera: Camera) -> dict[int, Grey]:
        """Those frames that can be read."""
        read = ((n, self._image(n, camera)) for n in frames)
        return {n: _grey(image) for n, image in read if image is not None}

    def _motion(self, target: int, others: Iterable[int]) -> NDArray[np.float64]:
        """``T_other_target`` ``(N, 4, 4)``."""
        return np.linalg.inv(self.T_world_camera[[*others]]) @ self.T_world_camera[target]

    def _image(self, index: int, camera: Camera) -> NDArray[np.uint8] | None:
        """A frame at a camera's size; None where it cannot be read."""
        try:
            return self.recording.image(index, camera.height, camera.width)
        except DataError:
            return None


class ManyViewTeacher:
    """Labels of several drives, kept in one folder.

    Args:
        folder: of all drives.
        size: height and width of the labels.
        stride: every how many frames there is one.
        cache_mb: memory for labels that were read.
        with_depth: else there are no labels, every frame may be a target, and no depth is bounded.
        learned: depth of an image, which is refined; it has to be one that processes can be given.
    """

    def __init__(
        self,
        folder: Path,
        size: tuple[int, int],
        stride: int,
        cache_mb: int = 0,
        with_depth: bool = True,
        learned: Learned | None = None,
    ) -> None:
        self._with_depth = with_depth
        self._learned = learned
        self._folder = folder
        self._size = size
        self._stride = stride if with_depth else 1
        self._labels = ArrayCache(cache_mb, (2, *size), np.float16)
        self._drives: dict[tuple[str, Path], DriveLabels] = {}

    def drive(self, recording: Recording) -> DriveLabels:
        """Where the labels of a recording are kept."""
        if recording.key not in self._drives:
            if recording.labels is not None:
                drive = DriveLabels(
                    recording, recording.labels, self._size, self._stride, True, recording.skipped
                )
            else:
                # of the camera, the names, sizes and times of the images, and the version of this file
                seen = f"{VERSION} {recording.camera} {recording.start} {len(recording)}"
                folder = self._folder / _digest(seen, sorted(set(recording.images)))
                drive = DriveLabels(recording, folder, self._size, self._stride)
            self._drives[recording.key] = drive
        return self._drives[recording.key]

    def structure(self, recording: Recording, first: int, sources: int) -> TeacherStructure:
        """Of the snippet that begins at a frame."""
        drive, target = self.drive(recording), first + sources // 2
        motion = snippet_motion(drive.T_world_camera, first, sources).astype(np.float32)
        if not self._with_depth:
            return TeacherStructure(
                motion, np.zeros(self._size, np.float16), np.full(self._size, np.inf, np.float16)
            )
        least, most = self._labels.get(
            (*recording.key, target), lambda: np.stack(drive.label(target))
        )
        return TeacherStructure(motion, least, most)

    def prepare(
        self, recordings: Sequence[Recording], sources: int, weights: str, progress: Progress
    ) -> None:
        """Compute what is not there yet, in as many processes as there are cores; a few labels in this one.

        Of several programs with one folder (the processes of a training on several devices) one
        computes and the others wait for it.

        Args:
            recordings: drives, or parts of prepared ones.
            sources: of a snippet, besides its target.
            weights: of the networks that the SLAM system uses for the poses.
            progress: told of the stage, what is done, and of how many.

        Raises:
            TrainingError: a drive has no trajectory or no scale, poses by other weights, or too few
                labels
                in a prepared folder.
        """
        with FolderLock() as lock:
            lock.take(self._folder, waits=True)
            drives = list(map(self.drive, recordings))
            for drive in drives:
                drive.require_weights(weights)
            without = [drive for drive in drives if not drive.poses_file.is_file()]
            tasks: list[tuple[DriveLabels, list[int]]] = []
            for drive in drives if self._with_depth else ():
                missing = [
                    target
                    for target in drive.targets(sources)
                    if not drive.label_file(target).is_file()
                ]
                for first in range(0, len(missing), _CHUNK):
                    tasks.append((drive, missing[first : first + _CHUNK]))
            for drive in (*without, *(drive for drive, _ in tasks)):
                if drive.compact:
                    raise TrainingError(
                        f"{drive.folder} lacks labels: prepare the data again with this teacher and size"
                    )
            for done, drive in enumerate(without):
                progress("teacher: poses", done, len(without))
                drive.measure_poses(weights)
            total, done = sum(len(chunk) for _, chunk in tasks), 0
            if len(tasks) == 1 and self._learned is None:  # a process would take longer to start
                ((drive, chunk),) = tasks
                with limit_library_threads():
                    progress("teacher: depth", drive.measure_labels(chunk), total)
            elif tasks:
                with processes("measures labels") as pool:
                    running = [
                        pool.submit(drive.measure_labels, chunk, self._learned)
                        for drive, chunk in tasks
                    ]
                    for future in as_completed(running):
                        done += future.result()
                        progress("teacher: depth", done, total)


def scene_of(root: Path, camera: Path, folder: Path) -> Path:
    """Images of a recording without distortion, with the camera and the mask that a run finds, made once in ``folder``.

    Args:
        root: images or a video.
        camera: ``auto``, and what else is known of it, for the run.
        folder: of all that is measured.

    Raises:
        OSError: no such path.
        DataError: the run or its export fails.
    """
    scene = folder / _digest(str(camera), [root]) / root.stem
    if not (scene / CAMERA_FILE).is_file():  # which comes after the images
        shutil.rmtree(scene, ignore_errors=True)
        with tempfile.TemporaryDirectory(prefix="erfsfm-camera-") as run:
            words = ["run", "--dataset", str(root), "--camera", str(camera), "--output", run]
            exported = ["export", run, "--what", "nerfstudio", "--output", str(scene)]
            if reason := slam_process(words + _RUN.split()) or slam_process(exported):
                raise DataError(f"the camera of {root} could not be found: {reason}")
            logger.warning("%s: %s", root, read_camera_file(Path(run) / CAMERA_FILE).source)
    return scene


def _digest(seen: str, files: Iterable[Path]) -> str:
    """Of what was ``seen``, and of the names, sizes and times of files."""
    for path in files:
        stat = path.stat()
        seen += f"\n{path.name} {stat.st_size} {stat.st_mtime_ns}"
    return hashlib.sha256(seen.encode()).hexdigest()[:_DIGITS]


def _grey(image: NDArray[np.uint8]) -> Grey:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
