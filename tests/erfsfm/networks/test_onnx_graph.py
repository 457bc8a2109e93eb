"""ONNX graphs have the outputs of their networks."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from erfsfm.networks import onnx_graph
from erfsfm.networks.deformable import DeformableConv2d
from erfsfm.networks.onnx_graph import Array, OnnxGraph, folder, keep, kept
from erfsfm.networks.presets import build
from erfsfm.networks.torch_network import tensors

SIZE = (1, 3, 64, 128)


def with_moving_taps(network: nn.Module) -> nn.Module:
    """With deformable layers that move their taps, as trained ones do."""
    for layer in network.modules():
        if isinstance(layer, DeformableConv2d):
            for convolution in (layer.offset, layer.modulator):
                nn.init.normal_(convolution.weight, std=0.02)
    return network.eval()


def inputs(kind: str, seed: int) -> tuple[Any, ...]:
    generator = np.random.default_rng(seed)
    images = [generator.uniform(-1, 1, SIZE).astype(np.float32) for _ in range(5)]
    return (images[0],) if kind == "depth" else (images[0], images[1:])


def calls_of(network: nn.Module) -> list[object]:
    """One entry for each forward pass of the network from now on."""
    calls: list[object] = []
    network.register_forward_pre_hook(lambda *_: calls.append(None))
    return calls


SLOW = ("erf-depthnet-dilated", "erf-depthnet-dfcv2", "erf-posenet-dfc", "erf-posenet-dfcv2")


@pytest.mark.parametrize(
    "name",
    ["depthnet", "posenet", "erf-posenet-dilated", "erf-depthnet-lite0"]
    + [pytest.param(name, marks=pytest.mark.slow) for name in SLOW],
)
@torch.inference_mode()
def test_a_graph_has_the_outputs_of_its_network_on_other_images_too(name: str):
    kind = "depth" if "depth" in name else "pose"
    network = with_moving_taps(build(name, width=0.125, sources=4))
    given = [inputs(kind, seed) for seed in range(3)]
    wanted: list[Tensor] = [network(*tensors(images)) for images in given]
    graph, calls = OnnxGraph(lambda: network, 1, "a network"), calls_of(network)
    for images, output in zip(given, wanted):
        assert np.abs(graph(*images) - output.numpy()).max() <= 1e-5 * output.abs().max()
    before = len(calls)
    graph(*given[0])
    assert len(calls) == before, "PyTorch computes what ONNX Runtime should"


NO_CODE = shutil.ignore_patterns("weights", "__pycache__")
IMAGE = np.ones((1, 3, 4, 4), np.float32)


class Times(nn.Module):
    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = factor

    def forward(self, image: Tensor) -> Tensor:
        return self.factor * image


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))


def output(factor: float, identity: str, image: Array = IMAGE) -> float:
    return float(OnnxGraph(lambda: Times(factor).eval(), 1, identity)(image).max())


def kept_graph(made_from: str, made: bytes) -> bytes:
    graph = kept(made_from)
    if graph is None:
        keep(made_from, made)
    return made if graph is None else graph


def test_the_graph_of_a_network_is_read_again_and_no_other(tmp_path: Path):
    assert output(2.0, "two") == 2.0
    assert folder() == tmp_path / "erfsfm" and len(list(folder().iterdir())) == 1
    assert output(3.0, "two") == 2.0, "the graph was made again"
    assert output(3.0, "three") == 3.0
    assert output(3.0, "two", np.ones((1, 3, 8, 8), np.float32)) == 3.0, (
        "the graph is of images of another size"
    )


def test_a_damaged_graph_is_made_again():
    assert kept_graph("one", b"graph") == b"graph"
    (file,) = folder().iterdir()
    for content in (b"", file.read_bytes()[:-1], file.read_bytes().replace(b"graph", b"graff")):
        file.write_bytes(content)
        assert kept_graph("one", b"graph") == b"graph"
    assert kept_graph("one", b"another") == b"graph"


@pytest.mark.parametrize("changed", ["networks/blocks.py", "geometry.py"])
def test_a_graph_of_older_code_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str
):
    package = shutil.copytree(
        Path(onnx_graph.__file__).parents[1], tmp_path / "code", ignore=NO_CODE
    )
    monkeypatch.setattr(onnx_graph, "__file__", str(package / "networks" / "onnx_graph.py"))
    assert kept_graph("one", b"old") == b"old" == kept_graph("one", b"new")
    (package / changed).write_text("# changed")
    assert kept_graph("one", b"new") == b"new"
