"""Single images of simulated worlds with their true depth as the label."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from erfsfm.common.errors import DataError
from erfsfm.config import DataConfig, ExperimentConfig
from erfsfm.data.array_cache import ArrayCache, ImageCache
from erfsfm.data.recordings import Recording
from erfsfm.data.samples import single_image

FARTHEST_M = 200.0  # what the simulator leaves unknown is sky; of a depth camera it may be anywhere


class ExactImages:
    """Images drawn from recordings with exact depth, each recording by its chance."""

    def __init__(
        self, recordings: Sequence[Recording], chances: NDArray[np.float64], config: ExperimentConfig, cache: ImageCache
    ) -> None:
        self._recordings, self._chances, self._config, self._cache = recordings, chances, config, cache
        self._size = (config.network.height, config.network.width)
        self._depth = ArrayCache(depth_mb(config.data), self._size, np.float32)

    def draw(self, rng: np.random.Generator) -> dict[str, Tensor]:
        """A `single_image` of a random frame."""
        recording = self._recordings[int(rng.choice(len(self._recordings), p=self._chances))]
        index = int(rng.integers(len(recording)))
        network, height_m = self._config.network, recording.camera_height_m
        assert height_m is not None, "recordings are exact"
        depth_m = self._depth.get((*recording.key, index), lambda: recording.shrunk_depth(index, *self._size))
        seen = depth_m > 0
        beyond = height_m / FARTHEST_M if recording.name.startswith("simulated/") else np.inf
        most = np.where(seen, height_m / np.where(seen, depth_m, 1), beyond)
        image = self._cache.image(recording, index)
        camera = recording.camera.resized(network.width, network.height, network.fidelity)
        return single_image(image, camera, [np.where(seen, most, 0), most], self._config, rng)


def depth_mb(config: DataConfig) -> int:
    """The part of ``data.cache_mb`` for exact depth."""
    return config.cache_mb // 5 if config.exact > 0 else 0


def by_label(recordings: Sequence[Recording], config: DataConfig) -> tuple[list[Recording], list[Recording]]:
    """The recordings with exact depth, if such are wanted, and those that a teacher measures.

    Raises:
        DataError: one kind is wanted and absent.
    """
    if config.exact == 0:
        return [], list(recordings)
    exact = [recording for recording in recordings if recording.exact]
    measured = [recording for recording in recordings if not recording.exact]
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
