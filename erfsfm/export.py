"""Networks as ONNX files, deformable layers as plain operators (GridSample), each checked against PyTorch.

The graphs are fixed to one image at the size of the weights: the maps of a deformable layer are part of the graph.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from erfsfm.checkpoint import Absent, Model
from erfsfm.common.errors import ExportError
from erfsfm.common.files import is_foreign, write_atomically
from erfsfm.common.onnx_session import open_session
from erfsfm.config import NetworkConfig
from erfsfm.networks.presets import NetworkKind
from erfsfm.networks.torch_network import exported

# of the largest output; a thousand roundings of float32
TOLERANCE = 1e-4
_MARK = "erfsfm_version"


@dataclass(frozen=True)
class Exported:
    """One written file, and the largest difference of its outputs from PyTorch's, relative to the largest output."""

    path: Path
    kind: NetworkKind
    preset: str
    difference: float


class DepthGraph(nn.Module):
    """``image`` ``(1, 3, H, W)`` to ``disparity`` ``(1, 1, H, W)``."""

    inputs, output = ("image",), "disparity"

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.eval()

    def forward(self, image: Tensor) -> Tensor:
        """Finest disparity, unscaled."""
        disparity: Tensor = self.network(image)
        return disparity


class PoseGraph(nn.Module):
    """``target`` ``(1, 3, H, W)`` and ``sources`` ``(1, N, 3, H, W)`` to ``T_source_target`` ``(1, N, 6)``."""

    inputs, output = ("target", "sources"), "T_source_target"

    def __init__(self, network: nn.Module, sources: int) -> None:
        super().__init__()
        self.network = network
        self.sources = sources
        self.eval()

    def forward(self, target: Tensor, sources: Tensor) -> Tensor:
        """Translation (unscaled) and XYZ Euler angles (radians) of each source, in time order."""
        vectors: Tensor = self.network(target, [sources[:, k] for k in range(self.sources)])
        return vectors


def pose_path(path: Path) -> Path:
    """Where the pose network goes if the depth network goes to ``path``: ``net_pose.onnx`` beside ``net.onnx``."""
    return path.with_name(f"{path.stem}_pose{path.suffix}")


def export_onnx(model: Model, path: Path, seed: int = 0) -> list[Exported]:
    """Write the depth network to ``path`` and the pose network to `pose_path`, if onnxruntime agrees with PyTorch.

    Args:
        model: of which a network that is absent is left out.
        path: must end in ``.onnx``.
        seed: of the random images on which both are compared.

    Raises:
        ExportError: another ending, outputs that differ, or a file in its place that is no such network.
        ConfigError: the paper's dilated depth network, which cannot run.
    """
    if path.suffix != ".onnx":
        raise ExportError(f"--output must end in .onnx; got {path}")
    nets = {path: model.depth_net, pose_path(path): model.pose_net}
    for file in (file for file, net in nets.items() if not isinstance(net, Absent)):
        if is_foreign(file, _MARK):
            raise ExportError(f"{file} is none of ours and would be replaced: choose another --output")
    config, generator = model.record.network, torch.Generator().manual_seed(seed)
    files = []
    if not isinstance(model.depth_net, Absent):
        graph = DepthGraph(model.depth_net)
        files.append(_export(graph, _images(config, generator, ()), path, "depth", config.depth, model))
    if not isinstance(model.pose_net, Absent):
        examples = [
            a + b for a, b in zip(_images(config, generator, ()), _images(config, generator, (config.sources,)))
        ]
        graph_of_pose = PoseGraph(model.pose_net, config.sources)
        files.append(_export(graph_of_pose, examples, pose_path(path), "pose", config.pose, model))
    return files


def _export(
    graph: DepthGraph | PoseGraph,
    examples: Sequence[tuple[Tensor, ...]],
    path: Path,
    kind: NetworkKind,
    preset: str,
    model: Model,
) -> Exported:
    content = _with_metadata(exported(graph, examples[0], graph.inputs, [graph.output]), kind, preset, model)
    difference = max(_difference(graph, content, example) for example in examples)
    if not difference <= TOLERANCE:
        raise ExportError(
            f"{path} was not written: onnxruntime differs from PyTorch by {difference:.1e} of the largest output of "
            f"{preset}, more than {TOLERANCE:.0e}; report the versions of torch, onnx and onnxruntime"
        )
    write_atomically(path, lambda temporary: temporary.write_bytes(content))
    return Exported(path, kind, preset, difference)


def _images(config: NetworkConfig, generator: torch.Generator, lead: tuple[int, ...]) -> list[tuple[Tensor, ...]]:
    """A smooth and a noisy example, each a one-tuple ``(1, *lead, 3, H, W)`` in [-1, 1]."""
    count = int(np.prod(lead, dtype=int))
    coarse = torch.rand(count, 3, 4, 8, generator=generator)
    smooth = nn.functional.interpolate(coarse, size=(config.height, config.width), mode="bilinear")
    noisy = torch.rand(count, 3, config.height, config.width, generator=generator)
    return [(2 * image.reshape(1, *lead, *image.shape[1:]) - 1,) for image in (smooth, noisy)]


def _with_metadata(content: bytes, kind: NetworkKind, preset: str, model: Model) -> bytes:
    """The checked graph with metadata: preset, fidelity, input range, licence and training data."""
    graph = onnx.load_model_from_string(content)
    onnx.checker.check_model(graph)
    record = model.record
    notes = {
        "network": preset,
        "kind": kind,
        "fidelity": record.network.fidelity,
        "input": "RGB in [-1, 1]",
        "licence": record.licence,
        "trained_on": json.dumps(record.trained_on),
        _MARK: record.version,
    }
    onnx.helper.set_model_props(graph, notes)
    serialised: bytes = graph.SerializeToString()
    return serialised


def _difference(graph: nn.Module, content: bytes, example: tuple[Tensor, ...]) -> float:
    """Largest difference of the two outputs, relative to the largest output."""
    session = open_session(content, torch.get_num_threads())
    names = [entry.name for entry in session.get_inputs()]
    (answer,) = session.run(None, {name: tensor.numpy() for name, tensor in zip(names, example)})
    with torch.no_grad():
        wanted: NDArray[np.float32] = graph(*example).numpy()
    if answer.shape != wanted.shape:
        return float("inf")
    return float(np.abs(answer - wanted).max() / max(np.abs(wanted).max(), 1e-30))
