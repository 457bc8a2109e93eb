"""Depth and motion of a snippet by classical two-view geometry: pseudo-labels for both networks.

Each source with the target gives depth up to the length of their motion. The lengths are brought to one unit where
both depths are certain, the depths are averaged, and all is expressed in heights of the camera over the road.
"""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.files import write_atomically
from erfsfm.labels.road import impose_road, road_plane
from erfsfm.labels.two_view import MotionAndDepth, two_view
from erfsfm.mvs.flow import rays

VERSION = 4
MIN_SNR = 5.0  # inverse depth over its sigma
OUTLIER = 3.0  # sigmas from the average
LEAST_SHARED = 100  # pixels
HEIGHTS = 10.0  # camera heights in the networks' unit of depth: steps are then as small as initial outputs


@dataclass(frozen=True)
class TeacherStructure:
    """Lengths are in heights of the camera over the road.

    Attributes:
        T_source_target: ``(N, 4, 4)``, NaN where nothing was measured; where only the translation's length
            is unknown, the translation alone is NaN.
        least: smallest inverse depth that agrees with the images, ``(H, W)`` float16, 0 where unbounded.
        most: largest one, infinite where unbounded.
    """

    T_source_target: NDArray[np.float32]
    least: NDArray[np.float16]
    most: NDArray[np.float16]


def measure_structure(images: Sequence[NDArray[np.uint8]], K: NDArray[np.float32]) -> TeacherStructure:
    """From the N + 1 images ``(H, W, 3)`` of a snippet, the target in the middle."""
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    middle = len(images) // 2
    views = [two_view(grey[middle], image, K, fine=abs(k - middle) > 1) for k, image in enumerate(grey) if k != middle]
    lengths = _relative_lengths(views)
    T_source_target = np.full((len(views), 4, 4), np.nan)
    for T, view, length in zip(T_source_target, views, lengths):
        if view is not None:
            T[:] = view.T_second_first
            T[:3, 3] *= length
    inverse_depth, sigma = _average(views, lengths, grey[middle].shape)
    forward = _forward(T_source_target)
    reliable = inverse_depth > MIN_SNR * sigma
    p = rays(inverse_depth.shape[0], inverse_depth.shape[1], K)
    plane = None if forward is None else road_plane(inverse_depth, reliable, p, forward)
    height, at_least = 1.0, np.zeros_like(inverse_depth)
    if plane is None:
        sigma[:] = np.inf
        moved = np.array([view is not None and not view.still for view in views])
        T_source_target[moved, :3, 3] = np.nan
    else:
        height = float(1 / np.linalg.norm(plane))
        road = p @ plane.astype(np.float32)
        at_least = impose_road(inverse_depth, sigma, reliable, road)
    T_source_target[:, :3, 3] /= height
    with np.errstate(over="ignore"):
        least = (np.maximum(inverse_depth - sigma, at_least) * height).astype(np.float16)
        most = ((np.maximum(inverse_depth, 0) + sigma) * height).astype(np.float16)
    return TeacherStructure(T_source_target.astype(np.float32), least, most)


def _forward(T_source_target: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Direction of travel in the target's frame, from the frames before to the frames after, ``(3,)``."""
    places = -np.swapaxes(T_source_target[:, :3, :3], 1, 2) @ T_source_target[:, :3, 3:]  # of the sources, (N, 3, 1)
    middle = len(places) // 2
    travelled = np.concatenate([-places[:middle, :, 0], places[middle:, :, 0]])
    travelled = travelled[np.isfinite(travelled).all(axis=1)]
    length = float(np.linalg.norm(travelled.sum(axis=0)))
    return travelled.sum(axis=0) / length if length > 0 else None


class StructureCache:
    """Measured structures as files named by a hash of their images; without a folder nothing is kept."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder

    def structure(self, images: Sequence[NDArray[np.uint8]], K: NDArray[np.float32]) -> TeacherStructure:
        """``measure_structure``, at most once for the same images and camera."""
        if self._folder is None:
            return measure_structure(images, K)
        digest = hashlib.sha256(f"{VERSION} {cv2.__version__}".encode() + K.tobytes())
        for image in images:
            digest.update(f"{image.shape}".encode() + image.tobytes())
        name = digest.hexdigest()[:32]
        path = self._folder / name[:2] / f"{name}.npz"
        kept = _read(path)
        if kept is None:
            kept = measure_structure(images, K)
            _write(path, kept)
        return kept


def _read(path: Path) -> TeacherStructure | None:
    """None if the file is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as entry:
            return TeacherStructure(entry["T_source_target"], entry["least"], entry["most"])
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        return None


def _write(path: Path, structure: TeacherStructure) -> None:
    def fill(part: Path) -> None:
        with part.open("wb") as file:  # given a path, savez would end its name in .npz
            np.savez(file, T_source_target=structure.T_source_target, least=structure.least, most=structure.most)

    write_atomically(path, fill)


def _relative_lengths(views: Sequence[MotionAndDepth | None]) -> list[float]:
    """Length of each view's translation over that of the most certain view; 0 if still, NaN if unknown."""
    reliable = [None if v is None or v.still else v.inverse_depth > MIN_SNR * v.sigma for v in views]
    counts = [0 if s is None else int(s.sum()) for s in reliable]
    best = int(np.argmax(counts))
    reference, reliable_reference = views[best], reliable[best]
    lengths: list[float] = []
    for view, reliable_view in zip(views, reliable):
        if view is None or reference is None or reliable_reference is None:
            lengths.append(0.0 if view is not None and view.still else np.nan)
        elif reliable_view is None:
            lengths.append(0.0)
        else:
            both = reliable_view & reliable_reference
            ratio = view.inverse_depth[both] / reference.inverse_depth[both]
            lengths.append(float(np.median(ratio)) if both.sum() >= LEAST_SHARED else np.nan)
    return lengths


def _average(
    views: Sequence[MotionAndDepth | None], lengths: Sequence[float], shape: tuple[int, ...]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Inverse depth and sigma of all views in the reference's unit; those far from the average are left out."""
    usable = [(v, s) for v, s in zip(views, lengths) if v is not None and s > 0]
    if not usable:
        return np.zeros(shape, np.float32), np.full(shape, np.inf, np.float32)
    values = np.stack([v.inverse_depth / np.float32(s) for v, s in usable])
    weights = np.stack([(np.float32(s) / v.sigma) ** 2 for v, s in usable])

    def mean(weights: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        total = weights.sum(axis=0)
        return (values * weights).sum(axis=0) / np.maximum(total, np.float32(1e-12)), total

    average, _ = mean(weights)
    average, total = mean(weights * (np.abs(values - average) * np.sqrt(weights) < OUTLIER))
    with np.errstate(divide="ignore"):
        return average, (1 / np.sqrt(total)).astype(np.float32)
