"""Trained networks in PyTorch as functions of arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

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
