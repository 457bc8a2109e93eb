"""Every network has the same outputs in onnxruntime as in PyTorch, and a wrong graph is never written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from torch import nn

from erfsfm.checkpoint import Model, build_networks
from erfsfm.common.errors import ExportError
from erfsfm.config import NetworkConfig
from erfsfm.export import export_onnx, pose_path
from erfsfm.model_record import ModelRecord
from erfsfm.networks.deformable import DeformableConv2d
from erfsfm.networks.presets import PRESETS

DEPTH = [name for name, preset in PRESETS.items() if preset.kind == "depth"]
POSE = [name for name, preset in PRESETS.items() if preset.kind == "pose"]


def fresh(**settings: Any) -> Model:
    """Small networks whose deformable taps really move."""
    config = NetworkConfig.model_validate(
        {"depth_width": 0.1, "pose_width": 0.2, "height": 64, "width": 96} | settings
    )
    nets = build_networks(config)
    for module in (m for net in nets.values() for m in net.modules()):
        if isinstance(module, DeformableConv2d):
            nn.init.normal_(module.offset.weight, std=0.3)
            nn.init.normal_(module.offset.bias, std=2.0)
            nn.init.normal_(module.modulator.weight, std=0.3)
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.uniform_(-0.1, 0.1)
            module.running_var.uniform_(0.5, 2.0)
    return Model(ModelRecord(network=config, trained_on=["simulated/0-9"]), nets)


def onnx_output(path: Path, **inputs: torch.Tensor) -> np.ndarray:
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    assert {entry.name for entry in session.get_inputs()} == set(inputs)
    return session.run(None, {name: value.numpy() for name, value in inputs.items()})[0]


@pytest.mark.parametrize(
    ("depth", "pose"),
    [  # networks/test_onnx_graph.py has graphs of the others
        pytest.param(*pair, marks=() if pair[0] == "depthnet" else pytest.mark.slow, id=pair[0])
        for pair in zip(DEPTH, POSE)
    ],
)
@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({}, marks=pytest.mark.slow),
        {"normalisation": "batch", "sources": 2, "height": 47, "width": 78},
    ],
    ids=str,
)
def test_all_presets(tmp_path: Path, depth: str, pose: str, settings: dict[str, Any]):
    model = fresh(depth=depth, pose=pose, **settings)
    export_onnx(model, tmp_path / "net.onnx")
    written = export_onnx(model, tmp_path / "net.onnx")  # its own files are replaced
    assert [(file.path.name, file.preset) for file in written] == [
        ("net.onnx", depth),
        ("net_pose.onnx", pose),
    ]
    assert all(file.difference < 1e-4 for file in written)
    config = model.record.network
    images = torch.rand(1 + config.sources, 1, 3, config.height, config.width) * 2 - 1
    with torch.no_grad():
        disparity, vectors = (
            model.networks["depth"](images[0]),
            model.networks["pose"](images[0], list(images[1:])),
        )
    np.testing.assert_allclose(
        onnx_output(tmp_path / "net.onnx", image=images[0]), disparity, rtol=1e-4
    )
    found = onnx_output(
        tmp_path / "net_pose.onnx",
        target=images[0],
        sources=images[1:].transpose(0, 1).contiguous(),
    )
    np.testing.assert_allclose(found, vectors, atol=1e-4 * float(vectors.abs().max()))


def test_a_file_that_nobody_named_is_not_replaced(tmp_path: Path):
    pose_path(tmp_path / "net.onnx").write_text("another network")
    with pytest.raises(ExportError, match=r"net_pose\.onnx is none of ours"):
        export_onnx(fresh(), tmp_path / "net.onnx")
    assert [path.name for path in tmp_path.iterdir()] == ["net_pose.onnx"]


@pytest.mark.parametrize(
    "pose",
    [
        "erf-posenet-dilated",
        *(pytest.param(f"erf-posenet-{n}", marks=pytest.mark.slow) for n in ("dfc", "dfcv2")),
    ],
)
def test_paper_fidelity(tmp_path: Path, pose: str):
    model = fresh(pose=pose, fidelity="paper", width=160, height=128)
    export_onnx(Model(model.record, {"pose": model.networks["pose"]}), tmp_path / "net.onnx")
    assert pose_path(tmp_path / "net.onnx").is_file()
