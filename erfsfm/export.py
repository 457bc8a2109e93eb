"""Networks as ONNX files, deformable layers as plain operators (GridSample), each checked against PyTorch.

The graphs are fixed to one image at the size of the weights: the maps of a deformable layer are part of the graph.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import torch
from torch import Tensor, nn

from erfsfm.checkpoint import Model
from erfsfm.common.errors import ExportError
from erfsfm.common.files import refuse_foreign, write_atomically
from erfsfm.common.processes import open_session
from erfsfm.config import NetworkKind
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


class PoseGraph(nn.Module):
    """``target`` ``(1, 3, H, W)`` and ``sources`` ``(1, N, 3, H, W)`` to ``T_source_target`` ``(1, N, 6)``."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, target: Tensor, sources: Tensor) -> Tensor:
        """Translation (unscaled) and XYZ Euler angles (radians) of each source, in time order."""
        vectors: Tensor = self.network(target, list(sources.unbind(1)))
        return vectors


def pose_path(path: Path) -> Path:
    """Where the pose network goes if the depth network goes to ``path``: ``net_pose.onnx`` beside ``net.onnx``."""
    return path.with_name(f"{path.stem}_pose{path.suffix}")


def export_onnx(model: Model, path: Path, seed: int = 0) -> list[Exported]:
    """Write the depth network to ``path`` and the pose network to `pose_path`, if onnxruntime agrees with PyTorch.

    Args:
        model: one network or both.
        path: must end in ``.onnx``.
        seed: of the random images on which both are compared.

    Raises:
        ExportError: another ending, outputs that differ, or a file in its place that is no such network.
        ConfigError: the paper's dilated depth network, which cannot run.
    """
    if path.suffix != ".onnx":
        raise ExportError(f"--output must end in .onnx; got {path}")
    config = model.record.network
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1 + config.sources, 3, 4, 8, generator=generator)
    smooth = nn.functional.interpolate(coarse, size=(config.height, config.width), mode="bilinear")
    noisy = torch.rand(*smooth.shape, generator=generator)
    examples = [(2 * images[:1] - 1, 2 * images[None, 1:] - 1) for images in (smooth, noisy)]
    paths = {"depth": path, "pose": pose_path(path)}
    for kind in model.networks:
        refuse_foreign([paths[kind]], _MARK, ExportError)
    files = []
    for kind, trained in model.networks.items():
        file, preset = paths[kind], getattr(config, kind)
        network = trained if kind == "depth" else PoseGraph(trained)
        inputs, output = (
            (["image"], "disparity")
            if kind == "depth"
            else (["target", "sources"], "T_source_target")
        )
        given = [dict(zip(inputs, example)) for example in examples]
        graph = exported(network.eval(), [*given[0].values()], inputs, [output])
        described = onnx.load_model_from_string(graph)
        onnx.checker.check_model(described)
        record = model.record
        notes = {
            "network": preset,
            "kind": kind,
            "fidelity": config.fidelity,
            "input": "RGB in [-1, 1]",
            "licence": record.licence,
            "trained_on": json.dumps(record.trained_on),
            _MARK: record.version,
        }
        onnx.helper.set_model_props(described, notes)
        content = described.SerializeToString()
        difference = max(_difference(network, content, each) for each in given)
        if not difference <= TOLERANCE:
            raise ExportError(
                f"{file} was not written: onnxruntime differs from PyTorch by {difference:.1e} of the largest output "
                f"of {preset}, more than {TOLERANCE:.0e}; report the versions of torch, onnx and onnxruntime"
            )
        write_atomically(file, content)
        files.append(Exported(file, kind, preset, difference))
    return files


def _difference(network: nn.Module, content: bytes, inputs: dict[str, Tensor]) -> float:
    """Largest difference of the two outputs, relative to the largest output."""
    session = open_session(content, torch.get_num_threads())
    (answer,) = session.run(None, {name: tensor.numpy() for name, tensor in inputs.items()})
    with torch.no_grad():
        wanted = network(*inputs.values()).numpy()
    if answer.shape != wanted.shape:
        return float("inf")
    return float(np.abs(answer - wanted).max() / max(np.abs(wanted).max(), 1e-30))
