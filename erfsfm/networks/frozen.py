"""A network traced into a TorchScript graph, for many forward passes at one image size.

The graph runs without Python: a quarter faster on a CPU, where a narrow network spends much of its time between its
layers, and other Python threads go on meanwhile.
"""

from __future__ import annotations

import warnings
from functools import partial

import torch
from torch import Tensor, nn

from erfsfm.networks.deformable import meets_kernel


class Frozen(nn.Module):
    """A network that is traced in its first forward pass, which takes about as long as ten of them.

    Outputs are the network's up to rounding. One that computes by the compiled kernel of deformable layers
    (``erfsfm.networks.deformable``) is faster as it is, and stays so.
    """

    def __init__(self, network: nn.Module) -> None:
        """Freeze a network in evaluation mode; all inputs will have the shapes of the first."""
        super().__init__()
        # Image sizes become constants of the graph, as intended. The filters are those of the whole process and stay:
        # the graph is traced in a thread, and `warnings.catch_warnings` is not safe there.
        warnings.filterwarnings("ignore", category=torch.jit.TracerWarning)  # type: ignore[attr-defined]
        warnings.filterwarnings("ignore", category=DeprecationWarning, module=r"torch\.jit\.")
        self.network = network
        self._is_frozen = False

    def forward(self, *inputs: Tensor | list[Tensor]) -> Tensor:
        """The network's output."""
        if not self._is_frozen:
            self.network = _graph(self.network, *inputs)
            self._is_frozen = True
        # PyTorch's own optimiser begins with slow passes, and gains nothing here
        with torch.jit.optimized_execution(False):  # type: ignore[attr-defined, no-untyped-call]
            output: Tensor = self.network(*inputs)
        return output


class _Function(nn.Module):
    """A network without parts or parameters: these are constants, and tracing does not go from part to part."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.function = partial(network.requires_grad_(False))

    def forward(self, *inputs: Tensor | list[Tensor]) -> Tensor:
        output: Tensor = self.function(*inputs)
        return output


@torch.inference_mode()
def _graph(network: nn.Module, *inputs: Tensor | list[Tensor]) -> nn.Module:
    if meets_kernel(network, *inputs):
        return network
    traced = torch.jit.trace(_Function(network).eval(), inputs, check_trace=False)
    graph: nn.Module = torch.jit.freeze(traced)  # type: ignore[no-untyped-call]
    return graph
