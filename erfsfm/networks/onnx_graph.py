"""Networks run by ONNX Runtime: half of PyTorch's processor time on a CPU, and no PyTorch where the graph is kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from onnxruntime import InferenceSession

from erfsfm.common.onnx_session import open_session
from erfsfm.networks.graph_folder import is_kept, keep, kept

if TYPE_CHECKING:
    from torch import nn

Array = NDArray[np.float32]


class OnnxGraph:
    """A network that is exported at its first call with inputs of each size and run by ONNX Runtime from then on.

    Outputs equal the network's up to rounding. A network with large deformable layers stays as it is: its graph takes
    minutes to make, and the compiled path of `erfsfm.networks.deformable` is faster.
    """

    def __init__(self, network: Callable[[], nn.Module], threads: int, identity: str = "") -> None:
        """Prepare.

        Args:
            network: gives it in evaluation mode, with one output; not called where its graph is kept.
            threads: to run on.
            identity: of the network with its weights, by which the graph is kept on disk; empty: it is not.
        """
        self._network = network
        self._threads = threads
        self._identity = identity
        self._infer: dict[str, Callable[..., Array]] = {}  # by the shapes of the inputs

    def __call__(self, *inputs: Array | list[Array]) -> Array:
        """The network's output."""
        key = self._key([array.shape for array in _flat(inputs)])
        if key not in self._infer:
            self._infer[key] = self._chosen(key, *inputs)
        return self._infer[key](*inputs)

    def is_kept(self, *shapes: tuple[int, ...]) -> bool:
        """Whether there is a graph for inputs of these shapes on disk."""
        return bool(self._identity) and is_kept(self._key(shapes))

    def _key(self, shapes: Sequence[tuple[int, ...]]) -> str:
        return f"{self._identity} {list(shapes)}"

    def _chosen(self, key: str, *inputs: Array | list[Array]) -> Callable[..., Array]:
        graph = kept(key) if self._identity else None
        if graph is None:
            from erfsfm.networks.deformable import has_large_sampling
            from erfsfm.networks.onnx_export import exported
            from erfsfm.networks.torch_network import TorchNetwork, tensors

            network, example = self._network(), tensors(inputs)
            if has_large_sampling(network, *example):
                return TorchNetwork(network, "cpu")
            graph = exported(network, example)
            if self._identity:
                keep(key, graph)
        return partial(_run, open_session(graph, self._threads))


def _flat(inputs: Sequence[Array | list[Array]]) -> list[Array]:
    return [array for given in inputs for array in (given if isinstance(given, list) else [given])]


def _run(session: InferenceSession, *inputs: Array | list[Array]) -> Array:
    names = [entry.name for entry in session.get_inputs()]
    output: Array = session.run(None, dict(zip(names, _flat(inputs), strict=True)))[0]
    return output
