"""Trained networks in PyTorch as functions of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from erfsfm.networks.lite0_pose import Lite0PoseNet

Array = NDArray[np.float32]


class TorchNetwork:
    """A network with one output, on a device."""

    def __init__(self, network: nn.Module, device: str) -> None:
        self._network, self._device = network.eval().to(device), device
        if device == "cpu":  # images are channels-last, and small kernels are faster so
            network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @torch.inference_mode()
    def __call__(self, *inputs: Array | list[Array]) -> Array:
        """The network's output for arrays, and lists of arrays."""
        output: Tensor = self._network(*tensors(inputs, self._device))
        return np.asarray(output.float().cpu().numpy())


def tensors(inputs: Sequence[Array | list[Array]], device: str = "cpu") -> list[Tensor | list[Tensor]]:
    """The same structure of tensors."""

    def moved(array: Array) -> Tensor:
        return torch.from_numpy(array).to(device)

    return [list(map(moved, given)) if isinstance(given, list) else moved(given) for given in inputs]


def inference_parts(depth_net: nn.Module, pose_net: nn.Module) -> dict[str, nn.Module]:
    """The networks that inference runs, by name: ``depth``, ``pose``, and ``features`` of an image where poses come
    from those.
    """
    if isinstance(pose_net, Lite0PoseNet):
        return {"depth": depth_net, "pose": _Motion(pose_net), "features": _Features(pose_net)}
    return {"depth": depth_net, "pose": pose_net}


class _Features(nn.Module):
    """What a pose network sees of one image."""

    def __init__(self, network: Lite0PoseNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        """``(1, 3, h, w)`` to ``(1, C, h / 16, w / 16)``."""
        return self.network.features(image)


class _Motion(nn.Module):
    """Pose vectors ``(1, N, 6)`` from the features of a target and of its sources."""

    def __init__(self, network: Lite0PoseNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, target: Tensor, sources: list[Tensor]) -> Tensor:
        """Translation (unscaled) and XYZ Euler angles of each source."""
        return cast(Tensor, self.network.motion(target, sources))  # a list in training alone
