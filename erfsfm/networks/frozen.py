"""A network traced and frozen to one TorchScript graph, for inference at one image size.

The graph runs without Python: a quarter faster on a CPU, where a narrow network spends as long between its layers as in
them, and other Python threads run meanwhile.
"""

from __future__ import annotations

import warnings
from functools import partial

import torch
from torch import Tensor, nn

from erfsfm.networks.deformable import meets_kernel


class Frozen(nn.Module):
    """A network that is traced and frozen at its first call, which takes about as long as ten calls.

    Outputs equal the network's up to rounding. A network that uses the compiled kernel of deformable layers
    (``erfsfm.networks.deformable``) is faster without a graph and is not traced.
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
        # PyTorch's profiling executor begins with slow passes, and is not faster here
        with torch.jit.optimized_execution(False):  # type: ignore[attr-defined, no-untyped-call]
            output: Tensor = self.network(*inputs)
        return output


class _Function(nn.Module):
    """A network as one function: its parameters are constants, and tracing does not visit its submodules."""

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
