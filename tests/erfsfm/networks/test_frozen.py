"""Frozen graphs have the outputs of their networks."""

from __future__ import annotations

import warnings
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from erfsfm.networks import deformable
from erfsfm.networks.deformable import DeformableConv2d
from erfsfm.networks.frozen import Frozen
from erfsfm.networks.presets import build

SIZE = (1, 3, 64, 128)


def with_moving_taps(network: nn.Module) -> nn.Module:
    """With deformable layers that move their taps, as trained ones do."""
    for layer in network.modules():
        if isinstance(layer, DeformableConv2d):
            for convolution in (layer.offset, layer.modulator):
                nn.init.normal_(convolution.weight, std=0.02)
    return network.eval()


def inputs(kind: str, seed: int) -> tuple[Any, ...]:
    generator = torch.Generator().manual_seed(seed)
    images = [2 * torch.rand(SIZE, generator=generator) - 1 for _ in range(5)]
    return (images[0],) if kind == "depth" else (images[0], images[1:])


@pytest.mark.parametrize(
    "name",
    [f"{erf}{kind}{variant}" for kind in ("depth", "pose") for erf, variant in (("", "net"), ("erf-", "net-dfcv2"))]
    + ["erf-depthnet-dilated", "erf-posenet-dilated", "erf-posenet-dfc"],
)
@torch.inference_mode()
def test_a_graph_has_the_outputs_of_its_network_on_other_images_too(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deformable, "_KERNEL_SAMPLES", 2**40)  # all in plain PyTorch
    kind = "depth" if "depth" in name else "pose"
    network = with_moving_taps(build(name, width=0.125, sources=4))
    graph = Frozen(network)
    for seed in range(3):
        given = inputs(kind, seed)
        wanted: Tensor = network(*given)
        assert (graph(*given) - wanted).abs().max() <= 1e-5 * wanted.abs().max()
    assert isinstance(graph.network, torch.jit.ScriptModule)


@torch.inference_mode()
def test_outputs_are_deterministic_from_the_first_call_on() -> None:
    graph = Frozen(with_moving_taps(build("erf-depthnet-dfcv2", width=0.125)))
    given = inputs("depth", 0)
    answers = [graph(*given) for _ in range(4)]
    assert all(torch.equal(answer, answers[0]) for answer in answers)


@torch.inference_mode()
def test_networks_with_compiled_layers_are_not_traced(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("numba")
    monkeypatch.setattr(deformable, "_KERNEL_SAMPLES", 1)
    network = with_moving_taps(build("erf-depthnet-dfc", width=0.25))
    graph = Frozen(network)
    graph(*inputs("depth", 0))
    assert graph.network is network


def test_a_network_that_raises_keeps_raising() -> None:
    class Refusing(nn.Module):
        def forward(self, image: Tensor) -> Tensor:
            raise ValueError("no network here")

    graph = Frozen(Refusing())
    for _ in range(2):
        with pytest.raises(ValueError, match="no network here"):
            graph(torch.zeros(SIZE))


def test_tracing_in_a_thread_warns_of_nothing_and_keeps_the_warning_filters() -> None:
    """`warnings.catch_warnings` would replace the filters of every thread while the graph is traced."""
    seen: list[object] = []

    class Watching(nn.Module):
        def forward(self, image: Tensor) -> Tensor:
            seen.append(warnings.filters)
            return image * bool(image.shape[0] > 0) if image.sum() < 1e9 else image

    with warnings.catch_warnings(record=True) as warned:
        graph = Frozen(Watching().eval())
        with ThreadPoolExecutor(1) as thread:
            thread.submit(graph, torch.zeros(SIZE)).result()
        assert all(filters is warnings.filters for filters in seen)
    assert isinstance(graph.network, torch.jit.ScriptModule)
    assert not warned
