"""A prepared folder: what a training needs of its data, at the networks' size, to train from elsewhere.

Each recording has a folder of its frames with the teacher's poses and labels beside them. Snippets to validate on are
recordings of their own, with their truth. Names, frame numbers and cameras are those of the originals, so that weights
record the same training data.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from erfsfm.common.config_tree import Section, dump_yaml, read_model
from erfsfm.common.errors import DataError
from erfsfm.common.files import write_atomically
from erfsfm.common.progress import Progress
from erfsfm.common.readers.images import report_unreadable
from erfsfm.config import NetworkConfig
from erfsfm.data.label_file import encode
from erfsfm.data.many_view_teacher import DriveLabels, ManyViewTeacher
from erfsfm.data.recordings import Recording
from erfsfm.data.window import Snippet
from erfsfm.geometry import Camera

INDEX_FILE = "prepared.yaml"
_POSES, _LABELS = (
    "poses.txt",
    "labels",
)  # of a recording: true poses of its camera (KITTI), and the teacher's
_MASK = "mask.png"
QUALITY = 90  # of the JPEG images: 16 kB each at 416x128
_MOST_FRAMES = 10**6  # of one recording: a day at ten frames a second


class _Entry(Section):
    """Consecutive frames of one recording, in a folder that its place in the index names."""

    name: str = Field(min_length=1, description="as in the leak record, without frames")
    start: int = Field(ge=0, description="number of the first frame")
    frames: int = Field(gt=0, le=_MOST_FRAMES)
    camera: Camera = Field(description="size and intrinsics of the images, pixels")
    camera_height_m: float | None = Field(default=None, gt=0, description="of a simulated world")


class _Index(Section):
    """The content of ``prepared.yaml``."""

    recordings: list[_Entry]


def _file(folder: Path, kind: Literal["images", "depth"], frame: int) -> Path:
    """An image, or true depth in 1/256 m, of a recording's folder."""
    return folder / kind / f"{frame:06d}{'.jpg' if kind == 'images' else '.png'}"


def read_prepared(root: Path) -> list[Recording]:
    """The recordings of a prepared folder; ``DataError`` where its index is damaged."""
    index = read_model(_Index, root / INDEX_FILE, DataError, "is damaged, prepare again")
    recordings = []
    for place, entry in enumerate(index.recordings):
        folder = root / f"{place:04d}"
        numbers, poses = range(entry.start, entry.start + entry.frames), folder / _POSES
        depth = tuple(
            path if (path := _file(folder, "depth", n)).is_file() else None for n in numbers
        )
        recording = Recording(
            entry.name,
            tuple(_file(folder, "images", n) for n in numbers),
            entry.camera,
            depth=depth if any(depth) else None,
            poses_file=poses if poses.is_file() else None,
            camera_height_m=entry.camera_height_m,
            start=entry.start,
            stored=entry.frames,
            without_stops=True,
            labels=folder / _LABELS,
            mask=mask if (mask := folder / _MASK).is_file() else None,
        )
        recordings.append(recording)
    return recordings


def write_prepared(
    output: Path,
    training: Sequence[Recording],
    held_out: Sequence[Snippet],
    teacher: ManyViewTeacher | None,
    network: NetworkConfig,
    progress: Progress,
) -> None:
    """Write a prepared folder, whole or not at all; one warning counts the images that cannot be read.

    Args:
        output: new or empty.
        training: recordings to train on; of those with exact depth this is kept, at the networks' size.
        held_out: snippets to validate on.
        teacher: whose measurements are kept, of the recordings without exact depth.
        network: whose size the frames get.
        progress: told of the stage, what is done, and of how many.
    """
    length, middle = network.sources + 1, network.sources // 2
    snippets = [
        snippet.recording.part(snippet.first, snippet.first + length) for snippet in held_out
    ]
    recordings = [*training, *snippets]
    unfinished = output.with_name(f".{output.name}.{os.getpid()}.partial")
    try:
        unreadable: list[str] = []
        for number, recording in enumerate(recordings):
            progress("frames", number, len(recordings))
            folder = unfinished / f"{number:04d}"
            unreadable += _write_images(folder, recording, network)
            if recording.mask is not None:
                shown = ~recording.fixed(network.height, network.width)
                image = cv2.imencode(".png", np.uint8(255) * shown)[1]
                write_atomically(folder / _MASK, bytes(image), sync=False)
            if number >= len(training):
                if (depth := recording.true_depth(middle)) is not None:
                    _write_depth(folder, recording.start + middle, depth)
                if (T_world_camera := recording.true_poses()) is not None:
                    np.savetxt(folder / _POSES, T_world_camera[:, :3].reshape(-1, 12), "%.9g")
            elif recording.exact:
                for index in range(len(recording)):
                    depth = recording.shrunk_depth(index, network.height, network.width)
                    _write_depth(folder, recording.start + index, depth)
            elif teacher is not None:
                _write_labels(teacher.drive(recording), folder / _LABELS, network)
        report_unreadable(unreadable, sum(map(len, recordings)), "images")
        entries = [
            _Entry(
                name=recording.name,
                start=recording.start,
                frames=len(recording),
                camera=recording.seen_by(network),
                camera_height_m=recording.camera_height_m,
            )
            for recording in recordings
        ]
        (unfinished / INDEX_FILE).write_text(dump_yaml(_Index(recordings=entries)))
        unfinished.replace(output)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _write_images(folder: Path, recording: Recording, network: NetworkConfig) -> list[str]:
    """Write the frames; returns what is wrong with those that cannot be read."""

    def shrink(index: int) -> str:
        try:
            image = recording.image(index, network.height, network.width)
        except DataError as error:
            return str(error)
        jpeg = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
        write_atomically(_file(folder, "images", recording.start + index), bytes(jpeg), sync=False)
        return ""

    one_by_one = recording.video is not None  # a video is decoded in order
    with ThreadPoolExecutor(1 if one_by_one else os.cpu_count()) as pool:
        return [problem for problem in pool.map(shrink, range(len(recording))) if problem]


def _write_depth(folder: Path, frame: int, depth_m: NDArray[np.float32]) -> None:
    values = np.clip(np.rint(depth_m * 256), 0, 65535).astype(np.uint16)
    write_atomically(
        _file(folder, "depth", frame), bytes(cv2.imencode(".png", values)[1]), sync=False
    )


def _write_labels(measured: DriveLabels, folder: Path, network: NetworkConfig) -> None:
    """Write the poses and labels that are there, labels in their compact form."""
    kept = DriveLabels(measured.recording, folder, measured.size, measured.stride, compact=True)
    kept.keep_poses(measured.T_world_camera)
    if measured.weights_file.is_file():
        shutil.copyfile(measured.weights_file, kept.weights_file)
    for target in measured.targets(network.sources):
        if measured.label_file(target).is_file():
            write_atomically(kept.label_file(target), encode(*measured.label(target)), sync=False)
