"""Networks as ONNX graphs, and their inference by ONNX Runtime: half of PyTorch's processor time on a CPU."""

from __future__ import annotations

import io
import threading
import warnings
from collections.abc import Callable, Sequence
from functools import partial

import torch
from onnxruntime import InferenceSession
from torch import Tensor, nn

from erfsfm.networks.deformable import has_large_sampling
from erfsfm.networks.graph_folder import kept_graph
from erfsfm.onnx_session import open_session

OPSET = 17
_exporter = threading.Lock()  # torch.onnx keeps its settings in global variables


class OnnxGraph:
    """A network that is exported at its first call and run by ONNX Runtime from then on.

    Outputs equal the network's up to rounding. A network with large deformable layers stays as it is: its graph takes
    minutes to make, and the compiled path of `erfsfm.networks.deformable` is faster.
    """

    def __init__(self, network: nn.Module, threads: int, identity: str = "") -> None:
        """Prepare.

        Args:
            network: in evaluation mode with one output; all inputs will have the shapes of the first.
            threads: to run on.
            identity: of the network with its weights, by which the graph is kept on disk; empty: it is not.
        """
        self._network = network
        self._threads = threads
        self._identity = identity
        self._infer: Callable[..., Tensor] | None = None

    def __call__(self, *inputs: Tensor | list[Tensor]) -> Tensor:
        """The network's output."""
        if self._infer is None:
            self._infer = self._chosen(*inputs)
        return self._infer(*inputs)

    def _chosen(self, *inputs: Tensor | list[Tensor]) -> Callable[..., Tensor]:
        if has_large_sampling(self._network, *inputs):
            return self._network
        export = partial(exported, self._network, inputs)
        shapes = [tuple(tensor.shape) for tensor in _flat(inputs)]
        graph = kept_graph(f"{self._identity} {shapes}", export) if self._identity else export()
        return partial(_run, open_session(graph, self._threads))


def _flat(inputs: Sequence[Tensor | list[Tensor]]) -> list[Tensor]:
    return [tensor for given in inputs for tensor in ([given] if isinstance(given, Tensor) else given)]


def _run(session: InferenceSession, *inputs: Tensor | list[Tensor]) -> Tensor:
    names = [entry.name for entry in session.get_inputs()]
    (output,) = session.run(None, {name: tensor.numpy() for name, tensor in zip(names, _flat(inputs), strict=True)})
    return torch.from_numpy(output)


@torch.inference_mode()
def exported(
    network: nn.Module,
    example: Sequence[Tensor | list[Tensor]],
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
) -> bytes:
    """An ONNX file of a network, for inputs of the example's shapes.

    Args:
        network: in evaluation mode.
        example: its inputs.
        inputs: their names, lists counted one by one.
        outputs: names of its outputs.
    """
    # Sizes become constants, as intended. The filters are those of the whole process and stay: graphs are made in a
    # thread, and `warnings.catch_warnings` is not safe there.
    warnings.filterwarnings("ignore", category=torch.jit.TracerWarning)  # type: ignore[attr-defined]
    warnings.filterwarnings("ignore", category=DeprecationWarning, module=r"torch\.(jit|onnx)\b")
    warnings.filterwarnings("ignore", module=r"torch\.onnx\b")
    file = io.BytesIO()
    with _exporter:
        torch.onnx.export(
            network,
            tuple(example),
            file,  # type: ignore[arg-type]  # in memory: no disk that may be full
            input_names=inputs,
            output_names=outputs,
            opset_version=OPSET,
            dynamo=False,  # the newer exporter needs onnxscript, and writes the same graph
        )
    return file.getvalue()
