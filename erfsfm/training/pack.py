"""Packing of a training's data: frames at the networks' size and the many-view teacher, as shards of any number.

The snippets to validate on are packed as files, with their true depth and poses.
"""

from __future__ import annotations

import io
import logging
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import ConfigError, DataError
from erfsfm.common.files import write_atomically
from erfsfm.common.progress import Progress, silent
from erfsfm.config import ExperimentConfig, NetworkConfig
from erfsfm.data.compact_label import encode
from erfsfm.data.exact_depth import by_label
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.data.pack_index import (
    PackedCamera,
    PackedRecording,
    PackIndex,
    ShardedRecording,
    depth_file,
    image_file,
    poses_file,
    write_index,
)
from erfsfm.data.recordings import Recording
from erfsfm.data.shards import CLIPS_FILE, FOLDER, MOST_SNIPPETS, POSES, ShardIndex, ShardWriter, clip_name
from erfsfm.data.snippets import ValidationSnippets, split_recordings, usable
from erfsfm.data.window import Snippet
from erfsfm.training.run import trained_on
from erfsfm.training.supervision import measured_views

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class PackSummary:
    """What was packed; ``size`` in bytes with the index and the snippets to validate on."""

    size: int
    shards: int
    frames: int
    labels: int


@dataclass(frozen=True)
class _Span:
    """A clip: ``frames`` frames of a recording, from its frame ``first``."""

    number: int
    recording: Recording
    first: int
    frames: int


def pack(
    config: ExperimentConfig, output: Path, megabytes: float = 4, quality: int = 85, progress: Progress = silent
) -> PackSummary:
    """Write what a training needs of its data as tar files, one clip after the other in random order.

    With ``teacher.views: many`` the measurements are packed as well, and made where they are not there yet. Simulated
    worlds whose exact depth is the label (``data.exact``) are left out: a training takes them as files beside the pack.

    Args:
        config: of the training, with all its data sets.
        output: new or empty; receives the index, the shards, and the snippets to validate on.
        megabytes: largest size of a shard, 1e6 bytes each.
        quality: of the JPEG images, 1 to 100.
        progress: told of the stage, what is done, and of how many.

    Raises:
        ConfigError: no place for the measurements, or ``output`` is taken.
        DataError: nothing to train on, or a clip is larger than a shard.
    """
    if config.teacher.views == "many" and config.teacher.cache is None:
        raise ConfigError("name the folder that keeps the teacher's measurements: --set teacher.cache=FOLDER")
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise ConfigError(f"--output {output} is not empty: choose a new folder; nothing was changed")
    training, validation = split_recordings(config.data)
    _, training = by_label(training, config.data)
    training = _readable_parts(usable(training, config.network.sources + 1), config.network)
    teacher = measured_views(training, config, config.teacher.cache or output, progress)
    unfinished = output.with_name(f".{output.name}.{os.getpid()}.partial")
    try:
        clips, labels = _write_clips(unfinished, training, config, teacher, megabytes, quality, progress)
        index = ShardIndex(
            files=int(clips[-1, 0]) + 1,
            most_bytes=int(megabytes * 1e6),
            sources=config.network.sources,
            teacher="none" if teacher is None else teacher.measures,
            stride=config.teacher.stride,
        )
        held_out = ValidationSnippets(validation, config).snippets if validation else []
        entries = [_write_snippet(unfinished, n, snippet, config, quality) for n, snippet in enumerate(held_out)]
        sharded = [ShardedRecording(**_described(recording, config)) for recording in training]
        write_index(unfinished, PackIndex(recordings=entries, shards=index, sharded=sharded))
        packed, _ = split_recordings(config.data.model_copy(update={"roots": [unfinished]}))
        if trained_on(packed) != trained_on(training):
            raise DataError(f"the pack would train on {trained_on(packed)}, not on {trained_on(training)}")
        unfinished.replace(output)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    size = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
    return PackSummary(size, index.files, sum(map(len, training)), labels)


def _readable_parts(recordings: Sequence[Recording], network: NetworkConfig) -> list[Recording]:
    """Parts of a snippet or more without an unreadable image, in order; one warning counts the images left out.

    Every image is decoded for this.

    Raises:
        DataError: no part is long enough.
    """
    parts: list[Recording] = []
    least = network.sources + 1
    reasons: list[str] = []
    for recording in recordings:
        ends = [-1]
        for index in range(len(recording)):
            try:
                recording.image(index, network.height, network.width)
            except DataError as error:
                reasons.append(str(error))
                ends.append(index)
        spans = zip([end + 1 for end in ends], [*ends[1:], len(recording)], strict=True)
        parts += [recording.part(start, stop) for start, stop in spans if stop - start >= least]
    if not reasons:
        return list(recordings)
    if not parts:
        raise DataError(f"no {least} consecutive images can be read: {reasons[0]}")
    total, kept = sum(map(len, recordings)), sum(map(len, parts))
    logger.warning(
        "%d of %d images cannot be read; %d are left out, with those of stretches shorter than a snippet: %s",
        len(reasons),
        total,
        total - kept,
        reasons[0],
    )
    return parts


def _described(recording: Recording, config: ExperimentConfig) -> dict[str, Any]:
    """What the index says of a recording in either form."""
    network = config.network
    camera = PackedCamera(**vars(recording.camera.resized(network.width, network.height, network.fidelity)))
    return {"name": recording.name, "start": recording.start, "frames": len(recording), "camera": camera}


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
    progress: Progress,
) -> tuple[NDArray[np.int64], int]:
    """Write the shards and the list of their clips; returns this list, and how many labels there are."""
    spans, rows, labels = _spans(training, config), [], 0
    shards = ShardWriter(output / FOLDER, int(megabytes * 1e6))
    for done, span in enumerate(spans):
        progress("packing", done, len(spans))
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
        yield f"{k:03d}.jpg", _jpeg(span.recording, span.first + k, config, quality)
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


def _write_snippet(
    output: Path, number: int, snippet: Snippet, config: ExperimentConfig, quality: int
) -> PackedRecording:
    """Write a snippet to validate on, with the truth of it that is known; returns its entry in the index."""
    middle, length, folder = config.network.sources // 2, config.network.sources + 1, f"{number:04d}"
    part = snippet.recording.part(snippet.first, snippet.first + length)
    for index in range(length):
        _put(image_file(output, folder, part.start + index), _jpeg(part, index, config, quality))
    depth = part.depth[middle] if part.depth else None
    if depth is not None:
        _put(depth_file(output, folder, part.start + middle), depth.read_bytes())
    T_world_camera = part.true_poses(config.network.fidelity)
    if T_world_camera is not None:
        rows = (" ".join(f"{value:.9g}" for value in T[:3].ravel()) for T in T_world_camera)
        _put(poses_file(output, folder), "".join(f"{row}\n" for row in rows).encode())
    return PackedRecording(
        **_described(part, config),
        folder=folder,
        poses=T_world_camera is not None,
        depth=[] if depth is None else [part.start + middle],
    )


def _jpeg(recording: Recording, index: int, config: ExperimentConfig, quality: int) -> bytes:
    """A frame at the networks' size; ``quality`` is 1 to 100."""
    image = recording.image(index, config.network.height, config.network.width)
    return bytes(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1])


def _put(path: Path, data: bytes) -> None:
    write_atomically(path, lambda part: part.write_bytes(data), sync=False)
