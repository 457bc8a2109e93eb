"""Simulated worlds with their true depth and poses as labels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from erfsfm.common.errors import DataError
from erfsfm.config import ExperimentConfig
from erfsfm.data.array_cache import ArrayCache
from erfsfm.data.recordings import Recording
from erfsfm.data.window import TeacherStructure, snippet_motion

FARTHEST_M = 200.0  # what the simulator leaves unknown is sky; of a depth camera it may be anywhere


class ExactLabels:
    """Labels of recordings with exact depth, in camera heights; ``size``: height and width of the images."""

    def __init__(self, size: tuple[int, int], cache_mb: int) -> None:
        self._size = size
        self._depth = ArrayCache(cache_mb, size, np.float32)
        self._poses: dict[tuple[str, Path], NDArray[np.float64] | None] = {}

    def bounds(self, recording: Recording, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Least and most inverse depth of a frame, each ``(H, W)``."""
        height_m = recording.camera_height_m
        assert height_m is not None, "recordings are exact"
        depth_m = self._depth.get((*recording.key, index), lambda: recording.shrunk_depth(index, *self._size))
        seen = depth_m > 0
        beyond = height_m / FARTHEST_M if recording.name.startswith("simulated/") else np.inf
        most = np.where(seen, height_m / np.where(seen, depth_m, 1), beyond).astype(np.float32)
        return np.where(seen, most, 0).astype(np.float32), most

    def structure(self, recording: Recording, first: int, sources: int) -> TeacherStructure:
        """Of the snippet that begins at a frame; its motion is unknown where the recording has no poses."""
        if recording.key not in self._poses:
            self._poses[recording.key] = recording.true_poses()
        T_world_camera = self._poses[recording.key]
        T_source_target = np.full((sources, 4, 4), np.nan, np.float32)
        if T_world_camera is not None and recording.camera_height_m is not None:
            T_source_target = snippet_motion(T_world_camera, first, sources).astype(np.float32)
            T_source_target[:, :3, 3] /= recording.camera_height_m
        return TeacherStructure(T_source_target, *self.bounds(recording, first + sources // 2))


def depth_mb(config: ExperimentConfig) -> int:
    """The part of ``data.cache_mb`` for exact depth."""
    return config.data.cache_mb // 5 if config.data.exact > 0 or config.teacher.exact else 0


def by_label(recordings: Sequence[Recording], config: ExperimentConfig) -> tuple[list[Recording], list[Recording]]:
    """The recordings of which single images with exact depth are drawn, and those of which snippets are."""
    exact = [recording for recording in recordings if recording.exact]
    measured = [recording for recording in recordings if not recording.exact]
    if config.teacher.exact and measured:
        raise DataError(
            f"teacher.views=exact needs the true depth of every recording; {measured[0].name} has none: simulate with "
            "--depth, or label real drives by teacher.views=many"
        )
    if config.data.exact == 0:
        return [], list(recordings)
    if not exact or not measured:
        raise DataError(
            "data.exact mixes simulated worlds that have depth maps (erfsfm-slam simulate --depth) with other "
            f"recordings; found {len(exact)} and {len(measured)}"
        )
    return exact, measured


def stacked(samples: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """A batch: of every tensor those of the samples that have it, in order."""
    keys = dict.fromkeys(key for sample in samples for key in sample)
    return {key: torch.stack([sample[key] for sample in samples if key in sample]) for key in keys}
