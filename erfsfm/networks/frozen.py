"""A network as one graph of tensor operations, for many answers at one size of image.

The graph is run without Python: a quarter faster on a CPU, where a narrow network spends as long between its layers as
in many of them, and other threads of Python go on meanwhile.
"""

from __future__ import annotations

import warnings
from functools import partial

import torch
from torch import Tensor, nn

from erfsfm.networks.deformable import meets_kernel


class Frozen(nn.Module):
    """A network that becomes a graph when it is asked for the first time, which takes about as long as ten answers.

    Answers are the network's up to rounding. One that computes by the compiled kernel of deformable layers
    (``erfsfm.networks.deformable``) is faster as it is, and stays so.
    """

    def __init__(self, network: nn.Module) -> None:
        """Freeze a network in evaluation mode; all inputs will have the shapes of the first."""
        super().__init__()
        self.network = network
        self._is_frozen = False

    def forward(self, *inputs: Tensor | list[Tensor]) -> Tensor:
        """The network's answer."""
        if not self._is_frozen:
            self.network = _graph(self.network, *inputs)
            self._is_frozen = True
        # PyTorch's own optimiser begins with slow passes, and gains nothing here
        with torch.jit.optimized_execution(False):  # type: ignore[attr-defined, no-untyped-call]
            answer: Tensor = self.network(*inputs)
        return answer


class _Function(nn.Module):
    """A network without parts or parameters: these are constants, and tracing does not go from part to part."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.answer = partial(network.requires_grad_(False))

    def forward(self, *inputs: Tensor | list[Tensor]) -> Tensor:
        answer: Tensor = self.answer(*inputs)
        return answer


@torch.inference_mode()
def _graph(network: nn.Module, *inputs: Tensor | list[Tensor]) -> nn.Module:
    if meets_kernel(network, *inputs):
        return network
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # sizes become constants: that is meant
        traced = torch.jit.trace(_Function(network).eval(), inputs, check_trace=False)
        graph: nn.Module = torch.jit.freeze(traced)  # type: ignore[no-untyped-call]
    return graph
