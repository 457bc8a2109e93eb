"""Errors of the many-view teacher's labels against true depth: by flow alone, and learned depth refined.

Example: python tools/label_errors.py --dataset worlds/600 --weights default
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from shared.command import one_line_errors, parser_of

from erfsfm.common.errors import DataError
from erfsfm.common.readers.images import read_image
from erfsfm.data.discovery import discover
from erfsfm.data.many_view_teacher import DriveLabels, Learned, ManyViewTeacher
from erfsfm.data.recordings import Recording
from erfsfm.evaluation.raw_drives import RawFrame, lidar_depth
from erfsfm.training.supervision import LearnedDepth

SIZE = (128, 416)
SOURCES = 4
STRIDE = 6  # frames between labels
FARTHEST_M = 80.0
WIDEST = 1.5  # most over least inverse depth of what counts as known


@one_line_errors()
def main() -> None:
    """One line for each recording and kind of label."""
    parser = parser_of(__doc__)
    parser.add_argument("--dataset", type=Path, required=True, help="with true depth, or a drive of KITTI raw")
    parser.add_argument("--weights", default="default", help="of the poses and of learned depth")
    arguments = parser.parse_args()
    for recording in discover(arguments.dataset):
        for line in compared(recording, arguments.weights):
            print(line)


def compared(recording: Recording, weights: str) -> list[str]:
    """Labels of a recording at the same poses: by flow alone, and learned depth refined."""
    lines = []
    with tempfile.TemporaryDirectory(prefix="erfsfm-labels-") as folder:
        T_world_camera = None
        kinds: dict[str, Learned | None] = {"flow": None, "refined": LearnedDepth(weights)}
        for kind, learned in kinds.items():
            teacher = ManyViewTeacher(Path(folder, kind), SIZE, STRIDE, learned=learned)
            drive = teacher.drive(recording)
            if T_world_camera is not None:
                drive.keep_poses(T_world_camera)
            teacher.prepare([recording], SOURCES, weights, lambda *_: None)
            T_world_camera = drive.T_world_camera
            lines.append(f"{recording.frames_name:40} {kind:8} {_errors(drive)}")
    return lines


def _errors(drive: DriveLabels) -> str:
    """Share of known pixels, and their relative errors after one scale of the drive."""
    ratios, known, counted = [], 0, 0
    for target in drive.targets(SOURCES):
        truth = _truth(drive.recording, target)
        if truth is None:
            continue
        least, most = (
            cv2.resize(bound.astype(np.float32), truth.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
            for bound in drive.label(target)
        )
        there = (truth > 0) & (truth < FARTHEST_M)
        narrow = there & (least > 0) & (most < WIDEST * least)
        ratios.append(1 / np.sqrt(least[narrow] * most[narrow]) / truth[narrow])
        known, counted = known + int(narrow.sum()), counted + int(there.sum())
    if not ratios:
        raise DataError(f"no true depth of {drive.recording.frames_name}: wanted depth maps or LiDAR")
    ratio = np.concatenate(ratios)
    error = np.abs(ratio / np.median(ratio) - 1)
    return f"known {known / counted:.2f}  median {np.median(error):.3f}  mean {error.mean():.3f}"


def _truth(recording: Recording, index: int) -> NDArray[np.float32] | None:
    """Depth of a frame in metres, 0 where there is none."""
    if recording.depth is not None:
        return recording.true_depth(index)
    image = recording.images[index]
    if not image.parents[1].name.startswith("image_0"):
        return None
    frame = RawFrame(image.parents[4], image.parents[2].name.removesuffix("_sync"), int(image.stem))
    try:
        return lidar_depth(frame, read_image(image).shape[:2])
    except DataError:
        return None


if __name__ == "__main__":
    main()
