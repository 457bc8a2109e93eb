"""Trained networks in PyTorch as functions of arrays, and as ONNX files."""

from __future__ import annotations

import io
import threading
import warnings
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

Array = NDArray[np.float32]
OPSET = 17
_exporter = threading.Lock()  # torch.onnx keeps its settings in global variables


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
        return output.float().cpu().numpy()


def tensors(
    inputs: Sequence[Array | list[Array]], device: str = "cpu"
) -> list[Tensor | list[Tensor]]:
    """The same structure of tensors."""

    def moved(array: Array) -> Tensor:
        return torch.from_numpy(array).to(device)

    return [
        list(map(moved, given)) if isinstance(given, list) else moved(given) for given in inputs
    ]


@torch.inference_mode()
def exported(
    network: nn.Module,
    example: Sequence[Tensor | list[Tensor]],
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    free: Sequence[int] = (),
) -> bytes:
    """An ONNX file of a network, for inputs of the example's shapes.

    Args:
        network: in evaluation mode.
        example: its inputs.
        inputs: their names, lists counted one by one.
        outputs: names of its outputs.
        free: axes of the named inputs whose size may differ from the example's.
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
            dynamic_axes={name: {axis: f"axis{axis}" for axis in free} for name in inputs or ()}
            if free
            else None,
            opset_version=OPSET,
            dynamo=False,  # the newer exporter needs onnxscript, and writes the same graph
        )
    return file.getvalue()
