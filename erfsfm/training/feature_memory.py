"""Features of images that a pose network's frozen encoder has seen before.

Where nothing but a flip is random about an image, it comes back unchanged, and its features with it: encoding is most
of a step's cost.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from erfsfm.config import ExperimentConfig
from erfsfm.networks.lite0_pose import PRETRAINED_STAGES, Lite0PoseNet


def features_recur(config: ExperimentConfig) -> bool:
    """Whether images and the part of the network that encodes them stay the same over a training of poses."""
    data, training = config.data, config.training
    images_stay = data.colour_jitter == 0 and data.zoom == 1 and data.weather == 0
    return training.networks == "pose" and training.frozen_stages >= PRETRAINED_STAGES and images_stay


class FeatureMemory:
    """Poses of snippets by features in half precision, each computed once.

    Args:
        network: whose encoder is frozen.
        megabytes: of the features that are kept; what comes later is computed every time.
    """

    def __init__(self, network: Lite0PoseNet, megabytes: int) -> None:
        self._network = network
        self._room = megabytes * 1_000_000
        self._known: dict[int, Tensor] = {}

    def poses(self, target: Tensor, sources: Sequence[Tensor], frames: Tensor) -> list[Tensor] | Tensor:
        """What the network gives for a batch.

        Args:
            target: ``(B, 3, H, W)`` in [-1, 1].
            sources: N images like the target.
            frames: a number of each image that no other image has, ``(B, N + 1)`` in time order.
        """
        middle = len(sources) // 2
        images = [*sources[:middle], target, *sources[middle:]]
        features = [self._of(image, frames[:, k].tolist()) for k, image in enumerate(images)]
        return self._network.motion(features.pop(middle), features)

    @torch.no_grad()
    def _of(self, images: Tensor, numbers: list[int]) -> Tensor:
        new = [k for k, number in enumerate(numbers) if number not in self._known]
        fresh: dict[int, Tensor] = {}
        if new:
            fresh = dict(zip(new, self._network.features(images[new]).half()))
        found = [fresh[k] if k in fresh else self._known[number] for k, number in enumerate(numbers)]
        for k, features in fresh.items():
            size = features.numel() * features.element_size()
            if size <= self._room:
                self._known[numbers[k]] = features.clone()
                self._room -= size
        return torch.stack(found)
