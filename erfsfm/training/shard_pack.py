"""Packing of a training's data into shards: a pack of any size, of which a training holds one tar file at a time."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.config import ExperimentConfig
from erfsfm.data.compact_label import encode
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.data.pack_index import PackedCamera, PackIndex, ShardedRecording, write_index
from erfsfm.data.readable import readable_parts
from erfsfm.data.recordings import Recording
from erfsfm.data.shards import (
    CLIPS_FILE,
    FOLDER,
    MOST_SNIPPETS,
    POSES,
    ShardIndex,
    clip_name,
    shard_name,
    webdataset,
)
from erfsfm.data.snippets import split_recordings, usable
from erfsfm.training.pack import TEACHER_FOLDER, jpeg, require_room, validation_drives, write_drive
from erfsfm.training.progress import stage_bars
from erfsfm.training.run import trained_on
from erfsfm.training.supervision import measured_views

_BLOCK = 512  # bytes of a tar file's header, to which members are filled up
_END = 10_240  # bytes to which a tar file is filled up, of which two blocks are its end
_MODE = 0o644
_OWNER = "erfsfm"


@dataclass(frozen=True)
class ShardSummary:
    """What was packed; ``size`` in bytes with the index and the snippets to validate on."""

    size: int
    files: int
    frames: int
    labels: int


@dataclass(frozen=True)
class _Span:
    """A clip: ``frames`` frames of a recording, from its frame ``first``."""

    number: int
    recording: Recording
    first: int
    frames: int


def pack_shards(
    config: ExperimentConfig, output: Path, megabytes: float = 64, quality: int = 85, quiet: bool = True
) -> ShardSummary:
    """Write what a training needs of its data as tar files, one clip after the other in random order.

    Args:
        config: of the training, with all its data sets.
        output: new or empty; receives the index, the shards, and the snippets to validate on.
        megabytes: largest size of a shard, 1e6 bytes each.
        quality: of the JPEG images, 1 to 100.
        quiet: no progress bar.

    Raises:
        ConfigError: no place for the measurements, ``output`` is taken, or webdataset is not installed.
        DataError: nothing to train on, or a clip is larger than a shard.
    """
    require_room(config, output)
    webdataset("writer", "TarWriter")
    training, validation = split_recordings(config.data)
    training = readable_parts(usable(training, config.network.sources + 1), config.network)
    teacher = measured_views(training, config, output / TEACHER_FOLDER, quiet)
    unfinished = output.with_name(f".{output.name}.{os.getpid()}.partial")
    try:
        clips, labels = _write_clips(unfinished, training, config, teacher, megabytes, quality, quiet)
        index = ShardIndex(
            files=int(clips[-1, 0]) + 1,
            most_bytes=int(megabytes * 1e6),
            sources=config.network.sources,
            teacher="none" if teacher is None else teacher.measures,
            stride=config.teacher.stride,
        )
        held_out = validation_drives(validation, config, quality)
        entries = [write_drive(unfinished, f"{n:04d}", drive, config) for n, drive in enumerate(held_out)]
        sharded = [_entry(recording, config) for recording in training]
        write_index(unfinished, PackIndex(recordings=entries, shards=index, sharded=sharded))
        packed, _ = split_recordings(config.data.model_copy(update={"roots": [unfinished]}))
        if trained_on(packed) != trained_on(training):
            raise DataError(f"the pack would train on {trained_on(packed)}, not on {trained_on(training)}")
        unfinished.replace(output)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    size = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
    return ShardSummary(size, index.files, sum(map(len, training)), labels)


def _entry(recording: Recording, config: ExperimentConfig) -> ShardedRecording:
    camera = PackedCamera(**vars(recording.camera.resized(config.network.width, config.network.height)))
    return ShardedRecording(name=recording.name, start=recording.start, frames=len(recording), camera=camera)


def _spans(training: list[Recording], config: ExperimentConfig) -> list[_Span]:
    """Clips of all recordings in random order; each begins with frames that snippets of the one before end with."""
    sources = config.network.sources
    spans = [
        _Span(number, recording, first, min(MOST_SNIPPETS + sources, len(recording) - first))
        for number, recording in enumerate(training)
        for first in range(0, len(recording) - sources, MOST_SNIPPETS)
    ]
    order = np.random.default_rng(config.training.seed).permutation(len(spans))
    return [spans[n] for n in order]


def _write_clips(
    output: Path,
    training: list[Recording],
    config: ExperimentConfig,
    teacher: ManyViewTeacher | None,
    megabytes: float,
    quality: int,
    quiet: bool,
) -> tuple[NDArray[np.int64], int]:
    """Write the shards and the list of their clips; returns this list, and how many labels there are."""
    spans, rows, labels = _spans(training, config), [], 0
    shards = _ShardWriter(output / FOLDER, int(megabytes * 1e6))
    with stage_bars(quiet) as show:
        for done, span in enumerate(spans):
            show("packing", done, len(spans))
            members = dict(_members(span, config, teacher, quality))
            first = span.recording.start + span.first
            shard = shards.write(clip_name(span.number, first), members)
            rows.append((shard, span.number, first, span.frames))
            labels += sum(name.endswith(".webp") for name in members)
    shards.close()
    clips = np.array(rows, dtype=np.int64)
    with (output / CLIPS_FILE).open("wb") as file:
        np.save(file, clips)
    return clips, labels


def _members(
    span: _Span, config: ExperimentConfig, teacher: ManyViewTeacher | None, quality: int
) -> Iterator[tuple[str, bytes]]:
    for k in range(span.frames):
        yield f"{k:03d}.jpg", jpeg(span.recording, span.first + k, config, quality)
    if teacher is None:
        return
    measured, sources = teacher.drive(span.recording), config.network.sources
    poses = io.BytesIO()
    np.save(poses, measured.T_world_camera[span.first : span.first + span.frames], allow_pickle=False)
    yield POSES, poses.getvalue()
    if teacher.measures == "depth and poses":
        for target in measured.targets(sources):
            k = target - span.first
            if sources // 2 <= k < span.frames - sources // 2:
                yield f"{k:03d}.webp", encode(*measured.label(target))


class _ShardWriter:
    """Tar files in a folder, each filled up to a number of bytes."""

    def __init__(self, folder: Path, most_bytes: int) -> None:
        self._folder = folder
        self._most = most_bytes
        self._number = -1
        self._size = most_bytes
        self._tar = None
        folder.mkdir(parents=True)
        (self._writer,) = webdataset("writer", "TarWriter")

    def write(self, name: str, members: dict[str, bytes]) -> int:
        """Add a clip; returns the number of the shard it is in.

        Raises:
            DataError: it is larger than a shard.
        """
        size = sum(_BLOCK + -(-len(data) // _BLOCK) * _BLOCK for data in members.values())
        if size + _END > self._most:
            raise DataError(
                f"{len(members)} images and labels take {(size + _END) / 1e6:.2f} MB: raise --shard-megabytes, or "
                "lower --quality"
            )
        if self._size + size + _END > self._most:
            self.close()
            self._number += 1
            self._size = 0
            path = self._folder / shard_name(self._number)
            self._tar = self._writer(str(path), _OWNER, _OWNER, _MODE, encoder=False, mtime=0)
        assert self._tar is not None
        self._tar.write({"__key__": name, **members})
        self._size += size
        return self._number

    def close(self) -> None:
        """Complete the last shard."""
        if self._tar is not None:
            self._tar.close()
