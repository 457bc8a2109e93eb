"""Streets with true depth.

Simulated worlds, KITTI raw drives with LiDAR, and folders of images beside depth maps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.files import read_text
from erfsfm.common.readers.images import list_images, read_depth_map, read_image
from erfsfm.common.readers.kitti import find_drives
from erfsfm.data.discovery import discover
from erfsfm.data.recordings import Recording
from erfsfm.evaluation.depth_metrics import CAP_M, Crop
from erfsfm.evaluation.eigen import RawFrame, lidar_depth

EVERY = 5  # frames of a recording or drive, of which one is compared
IMAGES = "images"
TRUTH = "truth"
MOVING = "moving"  # masks of the same names as the truth, not 0 where something moves
CAMERAS = "calib"  # a text a pair: fx fy cx cy of its image, pixels
PARTS = "static", "moving"
PER_METRE = 256.0  # value of a metre in a depth map

Image = NDArray[np.uint8]
Depth = NDArray[np.float32]


@dataclass(frozen=True)
class Street:
    """Frames of one drive in order.

    Attributes:
        name: of the drive, as the leak record writes it.
        seen: names with frames, for the leak record.
        frames: each gives an image ``(H, W, 3)`` and its true z-depth in metres ``(H, W)``, 0 where unknown.
        crop: part of the image that is compared.
        drive: words of a run of the SLAM system on all its frames; those of pairs are laid out in a new folder first,
            with the truth of one of the ``parts``.
        parts: of the truth: all of it, and where masks tell what moves, what stands and what moves.
        typical: a depth map that uses no image ``(H, W)``; None for LiDAR, whose points are few.
    """

    name: str
    seen: list[str]
    frames: list[Callable[[], tuple[Image, Depth]]]
    crop: Crop
    drive: Callable[[Path, str], list[str]]
    parts: tuple[str, ...] = ("",)
    typical: Depth | None = None


def find_streets(root: Path) -> list[Street]:
    """Every street under a root: all pairs of a folder, every fifth frame of a recording or a drive.

    Raises:
        DataError: there is none, or depth maps of different sizes.
    """
    if not root.exists():
        raise DataError(f"no data set at {root}: the path does not exist")
    streets = _of_pairs(root) or _of_drives(root) or _of_recordings(root)
    if not streets:
        raise DataError(
            f"no true depth in {root}: wanted sequences/NN/depth_2 (erfsfm-slam simulate --depth), KITTI raw drives "
            f"with velodyne_points, or {IMAGES}/ and {TRUTH}/ with 16-bit depth maps (metres x 256) of the same names"
        )
    return streets


def _of_pairs(root: Path) -> list[Street]:
    """Images and depth maps of the same names; a street is what their names have before the last underscore."""
    if not ((root / IMAGES).is_dir() and (root / TRUTH).is_dir()):
        return []
    streets: dict[str, Street] = {}
    for image in list_images(root / IMAGES):
        truth = root / TRUTH / f"{image.stem}.png"
        if truth.is_file():
            before = image.stem.rpartition("_")[0]
            name = f"folder/{root.resolve().name}" + (f"/{before}" if before else "")
            parts = ("", *PARTS) if (root / MOVING / truth.name).is_file() else ("",)
            new = Street(name, [name], [], "garg", partial(_laid_out, root, before), parts)
            street = streets.setdefault(name, new)
            street.frames.append(partial(_pair, image, truth))
    return [*streets.values()]


def _laid_out(root: Path, street: str, folder: Path, part: str) -> list[str]:
    """Pairs of a street as a sequence of KITTI's odometry, with the truth of a part."""
    sequence = folder / "sequences" / "00"
    for name in ("image_2", "depth_2"):
        (sequence / name).mkdir(parents=True)
    for image in list_images(root / IMAGES):
        before, _, number = image.stem.rpartition("_")
        truth, moving = (root / each / f"{image.stem}.png" for each in (TRUTH, MOVING))
        if before != street or not truth.is_file():
            continue
        (sequence / "image_2" / f"{number}{image.suffix}").symlink_to(image.resolve())
        depth = read_depth_map(truth)
        if part:
            depth[(read_image(moving)[..., 0] > 0) != (part == PARTS[1])] = 0
        written = np.round(depth * PER_METRE).astype(np.uint16)
        cv2.imwrite(str(sequence / "depth_2" / f"{number}.png"), written)
        file = root / CAMERAS / f"{image.stem}.txt"
        try:
            fx, fy, cx, cy = map(float, read_text(file).split()[:4])
        except (OSError, ValueError) as error:
            raise DataError(f"{file} must hold fx fy cx cy of its image: {error}") from error
    (sequence / "calib.txt").write_text(f"P2: {fx} 0 {cx} 0 0 {fy} {cy} 0 0 0 1 0\n")
    return ["--dataset", str(folder)]


def _on_its_own(root: Path, sequence: str, folder: Path, part: str) -> list[str]:
    return ["--dataset", str(root), "--sequence", sequence]


def _pair(image_file: Path, truth_file: Path) -> tuple[Image, Depth]:
    image, truth = read_image(image_file), read_depth_map(truth_file).astype(np.float32)
    if image.shape[:2] != truth.shape:
        raise DataError(
            f"{truth_file} has size {truth.shape[::-1]}, and its image {image.shape[1::-1]}: give one size"
        )
    return image, truth


def _of_drives(root: Path) -> list[Street]:
    """KITTI raw drives by their scans, in the crop of Garg et al."""
    streets = []
    for drive, folder in find_drives(root).items():
        files = (folder / "velodyne_points" / "data").glob("*.bin")
        scans = sorted(int(path.stem) for path in files)
        base = folder.absolute().parents[1]
        frames = [RawFrame(base, drive, index) for index in scans[::EVERY]]
        if frames:
            seen = [frame.name for frame in frames]
            street = Street(
                f"kitti_raw/{drive}", seen, [], "garg", partial(_on_its_own, root, drive)
            )
            street.frames.extend(partial(_scan, frame) for frame in frames)
            streets.append(street)
    return streets


def _scan(frame: RawFrame) -> tuple[Image, Depth]:
    image = read_image(frame.image_path())
    return image, lidar_depth(frame, image.shape[:2])


def _of_recordings(root: Path) -> list[Street]:
    """Recordings with depth maps; the parts of one between gaps are one street."""
    recordings = [recording for recording in discover(root) if any(recording.depth or ())]
    frames: list[tuple[Recording, int]] = []
    for recording in recordings:
        known = [index for index, file in enumerate(recording.depth or ()) if file is not None]
        frames += [(recording, index) for index in known[::EVERY]]
    truths = [_truth(recording, index) for recording, index in frames]
    if len({truth.shape for truth in truths}) > 1:
        raise DataError(
            f"depth maps of different sizes in {root}: evaluate recordings of one size at a time"
        )
    streets: dict[str, Street] = {}
    typical = _median_map(truths) if truths else None
    for recording in recordings:
        on_its_own = partial(_on_its_own, root, recording.sequence)
        new = Street(recording.name, [], [], "none", on_its_own, typical=typical)
        street = streets.setdefault(recording.name, new)
        street.seen.append(recording.frames_name)
    for recording, index in frames:
        streets[recording.name].frames.append(partial(_frame, recording, index))
    return [*streets.values()]


def _truth(recording: Recording, index: int) -> Depth:
    truth = recording.true_depth(index)
    assert truth is not None, "frames with a depth map"
    return truth


def _frame(recording: Recording, index: int) -> tuple[Image, Depth]:
    truth = _truth(recording, index)
    return recording.image(index, *truth.shape), truth  # prepared images are smaller


def _median_map(truths: list[Depth]) -> Depth:
    """Per-pixel median of the true depth, the sky at the cap; every map has the first one's size."""
    stacked = np.stack([np.where((t > 0) & (t < CAP_M), t, np.nan) for t in truths])
    known = np.isfinite(stacked).any(axis=0)
    median = np.full(stacked.shape[1:], CAP_M, dtype=np.float32)
    median[known] = np.nanmedian(stacked[:, known], axis=0)
    return median
