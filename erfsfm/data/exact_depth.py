"""Single images of simulated worlds with their true depth as the label."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from erfsfm.common.errors import DataError
from erfsfm.config import DataConfig, ExperimentConfig
from erfsfm.data.array_cache import ImageCache
from erfsfm.data.recordings import Recording
from erfsfm.data.samples import single_image

FARTHEST_M = 200.0  # what the simulator leaves unknown is sky


class ExactImages:
    """Images drawn from simulated worlds, each world as often as the others."""

    def __init__(self, recordings: Sequence[Recording], config: ExperimentConfig, cache: ImageCache) -> None:
        self._recordings, self._config, self._cache = recordings, config, cache

    def draw(self, rng: np.random.Generator) -> dict[str, Tensor]:
        """A `single_image` of a random frame."""
        recording = self._recordings[int(rng.integers(len(self._recordings)))]
        index = int(rng.integers(len(recording)))
        network = self._config.network
        depth_m, height_m = recording.true_depth(index), recording.camera_height_m
        assert depth_m is not None and height_m is not None, "recordings are exact"
        depth_m = cv2.resize(depth_m, (network.width, network.height), interpolation=cv2.INTER_NEAREST_EXACT)
        seen = depth_m > 0
        most = height_m / np.where(seen, depth_m, FARTHEST_M)
        image = self._cache.image(recording, index)
        camera = recording.camera.resized(network.width, network.height, network.fidelity)
        return single_image(image, camera, [np.where(seen, most, 0), most], self._config, rng)


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
