"""Packing of a training's data: frames at the networks' size and the many-view teacher, within a number of bytes.

Real recordings are packed whole. Simulated ones, which can be made again, are shortened to one number of frames.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import ConfigError, DataError
from erfsfm.common.files import write_atomically
from erfsfm.config import ExperimentConfig
from erfsfm.data.compact_label import encode
from erfsfm.data.many_view_teacher import DriveLabels, ManyViewTeacher
from erfsfm.data.pack_index import (
    PackedCamera,
    PackedRecording,
    PackIndex,
    depth_file,
    image_file,
    poses_file,
    write_index,
)
from erfsfm.data.readable import readable_parts
from erfsfm.data.recordings import Recording
from erfsfm.data.snippets import ValidationSnippets, split_recordings, usable
from erfsfm.training.progress import stage_bars
from erfsfm.training.run import trained_on
from erfsfm.training.supervision import measured_views

TEACHER_FOLDER = "teacher"
_INDEX_BYTES = 320  # of a recording, at most
_POSE_BYTES, _HEADER_BYTES = 128, 128  # of poses.npy
_TRUE_POSE_BYTES = 200  # of a line, at most


@dataclass(frozen=True)
class PackSummary:
    """What a pack holds, and what of the training data it does not."""

    size: int
    real_frames: int
    simulated_frames: int
    labels: int
    image_bytes: int
    label_bytes: int
    frames_left_out: int
    labels_left_out: int


@dataclass(frozen=True)
class PackedDrive:
    """A recording as files in memory; ``labels`` and ``depth`` by frame, counted from its first."""

    recording: Recording
    images: list[bytes]
    labels: dict[int, bytes] = field(default_factory=dict)
    measured: DriveLabels | None = None
    depth: dict[int, bytes] = field(default_factory=dict)
    true_poses: NDArray[np.float64] | None = None

    def first(self, frames: int, sources: int) -> PackedDrive:
        """Its first frames alone, and the labels that have half of ``sources`` on either side."""
        last = min(frames, len(self.images)) - sources // 2
        labels = {target: data for target, data in self.labels.items() if target < last}
        return PackedDrive(self.recording.part(0, frames), self.images[:frames], labels, self.measured)

    @property
    def is_simulated(self) -> bool:
        """Whether it can be made again, and may be shortened."""
        return self.recording.name.startswith("simulated/")

    @property
    def size(self) -> int:
        """Bytes of all its files."""
        files = [*self.images, *self.labels.values(), *self.depth.values()]
        poses = _HEADER_BYTES + _POSE_BYTES * len(self.images) if self.measured else 0
        true_poses = 0 if self.true_poses is None else _TRUE_POSE_BYTES * len(self.images)
        return sum(map(len, files)) + poses + true_poses + _INDEX_BYTES


def pack(
    config: ExperimentConfig, output: Path, megabytes: float = 60, quality: int = 85, quiet: bool = True
) -> PackSummary:
    """Write what a training needs of its data to a folder that trains in its place.

    With ``teacher.views: many`` the measurements are packed as well, and made where they are not there yet.

    Args:
        config: of the training, with all its data sets.
        output: new or empty; receives the pack, and in ``teacher/`` the measurements.
        megabytes: largest size of all files together, 1e6 bytes each.
        quality: of the JPEG images, 1 to 100.
        quiet: no progress bar.

    Raises:
        ConfigError, DataError: no place for the measurements, ``output`` is taken, or too few megabytes.
    """
    require_room(config, output)
    training, validation = split_recordings(config.data)
    training = readable_parts(usable(training, config.network.sources + 1), config.network)
    teacher = measured_views(training, config, output / TEACHER_FOLDER, quiet)
    drives = []
    with stage_bars(quiet) as show:
        for done, recording in enumerate(training):
            show("packing", done, len(training))
            drives.append(_encoded(recording, config, teacher, quality))
    held_out = validation_drives(validation, config, quality)
    kept = _fitting(drives, int(megabytes * 1e6) - sum(drive.size for drive in held_out), config)
    unfinished = output.with_name(f".{output.name}.{os.getpid()}.partial")
    try:
        entries = [write_drive(unfinished, f"{n:04d}", drive, config) for n, drive in enumerate([*kept, *held_out])]
        write_index(unfinished, PackIndex(recordings=entries))
        _write_teacher(unfinished, kept, config, trained_on(training))
        unfinished.replace(output)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return _summary(output, drives, kept)


def require_room(config: ExperimentConfig, output: Path) -> None:
    """Refuse a folder that is taken, and a teacher without a folder for its measurements.

    Raises:
        ConfigError: one line with what to do.
    """
    if config.teacher.views == "many" and config.teacher.cache is None:
        raise ConfigError("name the folder that keeps the teacher's measurements: --set teacher.cache=FOLDER")
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise ConfigError(f"--output {output} is not empty: choose a new folder; nothing was changed")


def _encoded(
    recording: Recording, config: ExperimentConfig, teacher: ManyViewTeacher | None, quality: int
) -> PackedDrive:
    images = [jpeg(recording, index, config, quality) for index in range(len(recording))]
    if teacher is None:
        return PackedDrive(recording, images)
    measured = teacher.drive(recording)
    targets = measured.targets(config.network.sources) if teacher.measures == "depth and poses" else ()
    labels = {target: encode(*measured.label(target)) for target in targets}
    return PackedDrive(recording, images, labels, measured)


def validation_drives(recordings: list[Recording], config: ExperimentConfig, quality: int) -> list[PackedDrive]:
    """One for each snippet to validate on, with true depth of its target and true poses where they are known."""
    drives = []
    middle, length = config.network.sources // 2, config.network.sources + 1
    for snippet in ValidationSnippets(recordings, config).snippets if recordings else ():
        part = snippet.recording.part(snippet.first, snippet.first + length)
        images = [jpeg(part, index, config, quality) for index in range(length)]
        truth = part.depth[middle] if part.depth else None
        depth = {} if truth is None else {middle: truth.read_bytes()}
        drives.append(PackedDrive(part, images, depth=depth, true_poses=part.true_poses(config.network.fidelity)))
    return drives


def jpeg(recording: Recording, index: int, config: ExperimentConfig, quality: int) -> bytes:
    """A frame at the networks' size as JPEG; ``quality`` is 1 to 100."""
    image = recording.image(index, config.network.height, config.network.width)
    return bytes(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1])


def _fitting(drives: list[PackedDrive], room: int, config: ExperimentConfig) -> list[PackedDrive]:
    """The drives with simulated ones shortened to the most frames that fit.

    Raises:
        DataError: even the shortest do not fit.
    """
    sources, stride = config.network.sources, config.teacher.stride

    def shortened(frames: int) -> list[PackedDrive]:
        return [drive.first(frames, sources) if drive.is_simulated else drive for drive in drives]

    def size(frames: int) -> int:
        return sum(drive.size for drive in shortened(frames))

    half = sources // 2
    most = max(len(drive.images) for drive in drives)
    few = min(-(-half // stride) * stride + half + 1, most)  # around the first label
    if size(few) > room:
        raise DataError(
            f"the pack needs {(size(few) - room) / 1e6:.1f} MB more at least: allow more --megabytes, lower --quality, "
            "raise teacher.stride, or name fewer real recordings"
        )
    while few < most:
        middle = (few + most + 1) // 2
        few, most = (middle, most) if size(middle) <= room else (few, middle - 1)
    return shortened(few)


def write_drive(output: Path, folder: str, drive: PackedDrive, config: ExperimentConfig) -> PackedRecording:
    """Write a drive's files under ``output``; returns its entry in the index."""
    recording = drive.recording
    for number, data in enumerate(drive.images, recording.start):
        _put(image_file(output, folder, number), data)
    for index, data in drive.depth.items():
        _put(depth_file(output, folder, recording.start + index), data)
    if drive.true_poses is not None:
        rows = (" ".join(f"{value:.9g}" for value in T[:3].ravel()) for T in drive.true_poses)
        _put(poses_file(output, folder), "".join(f"{row}\n" for row in rows).encode())
    return PackedRecording(
        name=recording.name,
        start=recording.start,
        frames=len(recording),
        folder=folder,
        camera=PackedCamera(**vars(recording.camera.resized(config.network.width, config.network.height))),
        poses=drive.true_poses is not None,
        depth=[recording.start + index for index in drive.depth],
    )


def _write_teacher(output: Path, kept: list[PackedDrive], config: ExperimentConfig, wanted: list[str]) -> None:
    """Measurements under the digests of the packed images; first the pack is read as a training will read it."""
    packed, _ = split_recordings(config.data.model_copy(update={"roots": [output]}))
    if trained_on(packed) != wanted:
        raise DataError(f"the pack would train on {trained_on(packed)} where {wanted} was asked for")
    size = (config.network.height, config.network.width)
    teacher = ManyViewTeacher(output / TEACHER_FOLDER, size, config.teacher.stride)
    for recording, drive in zip(packed, kept, strict=True):
        if drive.measured is not None:
            labels = teacher.drive(recording)
            labels.keep_poses(drive.measured.T_world_camera[: len(recording)])
            for target, data in drive.labels.items():
                _put(labels.compact_file(target), data)


def _put(path: Path, data: bytes) -> None:
    write_atomically(path, lambda part: part.write_bytes(data), sync=False)


def _summary(output: Path, drives: list[PackedDrive], kept: list[PackedDrive]) -> PackSummary:
    frames, labels = (sum(len(part) for part in parts) for parts in zip(*((d.images, d.labels) for d in kept)))
    simulated = sum(len(drive.images) for drive in kept if drive.is_simulated)
    return PackSummary(
        size=sum(path.stat().st_size for path in output.rglob("*") if path.is_file()),
        real_frames=frames - simulated,
        simulated_frames=simulated,
        labels=labels,
        image_bytes=sum(len(data) for drive in kept for data in drive.images),
        label_bytes=sum(len(data) for drive in kept for data in drive.labels.values()),
        frames_left_out=sum(len(drive.images) for drive in drives) - frames,
        labels_left_out=sum(len(drive.labels) for drive in drives) - labels,
    )
