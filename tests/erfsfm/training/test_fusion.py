"""The network that fuses depth, and its training."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch
from onnxruntime import InferenceSession

from erfsfm.cli import main
from erfsfm.mvs.fusion import CHANGE, CHANNELS, DepthFusion
from erfsfm.training.fusion import FusionNet, fusion_loss

Cli = Callable[..., tuple[int, str, str]]


def test_the_loss_is_least_at_the_truth_and_where_the_sigma_is_the_error():
    wanted = torch.linspace(-0.5, 0.5, 96).reshape(1, 8, 12)
    known = torch.ones_like(wanted, dtype=torch.bool)
    sigma = torch.full_like(wanted, -2.0)
    right = fusion_loss(wanted, sigma, wanted, known)
    assert right < fusion_loss(wanted + 0.1, sigma, wanted, known)
    off = [
        fusion_loss(wanted + 0.2, torch.full_like(wanted, log), wanted, known)
        for log in np.log([0.1, 0.2, 0.4])
    ]
    assert off[1] < min(off[0], off[2])
    sky = torch.zeros_like(known)
    farther = fusion_loss(wanted - 1, sigma, wanted, sky)
    assert (
        farther
        == fusion_loss(wanted - 2, sigma, wanted, sky)
        < fusion_loss(wanted + 1, sigma, wanted, sky)
    )


@pytest.mark.slow
def test_a_network_is_trained_on_worlds_and_refines_a_run(tmp_path, command_line, monkeypatch):
    """On a processor that does not compute with bfloat16, training does not either."""
    forward, in_bfloat16 = FusionNet.forward, set()

    def recorded(net: FusionNet, evidence: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        if net.training:
            in_bfloat16.add(torch.is_autocast_enabled("cpu"))
        return forward(net, evidence)

    monkeypatch.setattr(FusionNet, "forward", recorded)
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict)
    for seed in (3, 4):
        simulate = [
            "simulate",
            str(tmp_path / f"{seed}"),
            "--seed",
            str(seed),
            "--frames",
            "20",
            "--route",
            "grid",
        ]
        subprocess.run(
            [sys.executable, "-m", "slam", *simulate, "--depth"], check=True, capture_output=True
        )
    roots = ["--dataset", tmp_path / "3", "--validation", tmp_path / "4"]
    words = [
        "train-fusion",
        *roots,
        "--output",
        tmp_path / "net",
        "--weights",
        "sim",
        "--samples",
        80,
        "--steps",
        20,
    ]
    code, out, _ = command_line(main, "erfsfm", *words, "--json")
    (metrics,) = json.loads(out)
    assert code == 0 and metrics["fused_mean"] < metrics["guess_mean"]
    assert in_bfloat16 == {False}
    run = [
        "run",
        "--dataset",
        str(tmp_path / "4"),
        "--weights",
        "sim",
        "--set",
        f"depth.fusion={tmp_path / 'net'}",
    ]
    done = subprocess.run(
        [sys.executable, "-m", "slam", *run, "--output", str(tmp_path / "run")], capture_output=True
    )
    assert done.returncode == 0, done.stderr
    assert (
        json.loads((tmp_path / "run" / "metrics.json").read_text())["depth"]["refined"][
            "median_rel"
        ]
        < 0.5
    )


def test_a_network_begins_with_the_shipped_one():
    evidence = torch.randn(1, CHANNELS, 16, 24, generator=torch.Generator().manual_seed(0))
    net = FusionNet(CHANNELS, 4 * CHANGE)
    path = DepthFusion("default").path
    net.begin_with(path)
    shipped = InferenceSession(path).run(None, {"evidence": evidence.numpy()})
    for found, expected in zip(net(evidence), shipped, strict=True):
        np.testing.assert_allclose(found.detach().numpy(), expected, atol=1e-4)


def test_a_fresh_network_trusts_the_measurement_at_every_pixel():
    evidence = torch.zeros(1, CHANNELS, 16, 24)
    block = evidence[:, 4 * CHANGE : 4 * CHANGE + 4]
    block[:] = torch.rand(block.shape)
    change, log_sigma = FusionNet(CHANNELS, 4 * CHANGE).eval()(evidence)
    measured = torch.nn.functional.pixel_shuffle(block, 2)[:, 0]
    torch.testing.assert_close(
        change / measured, torch.full_like(measured, torch.sigmoid(torch.tensor(3.0)).item())
    )
    assert log_sigma.shape == change.shape == (1, 32, 48)
