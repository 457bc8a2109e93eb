"""Networks as ONNX files."""

from __future__ import annotations

import io
import threading
import warnings
from collections.abc import Sequence

import torch
from torch import Tensor, nn

OPSET = 17
_exporter = threading.Lock()  # torch.onnx keeps its settings in global variables


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
            dynamic_axes={name: {axis: f"axis{axis}" for axis in free} for name in inputs or ()} if free else None,
            opset_version=OPSET,
            dynamo=False,  # the newer exporter needs onnxscript, and writes the same graph
        )
    return file.getvalue()
