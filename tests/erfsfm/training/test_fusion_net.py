"""The network that fuses depth."""

from __future__ import annotations

import torch

from erfsfm.mvs.fusion import CHANGE, CHANNELS
from erfsfm.training.fusion_net import FusionNet


def test_a_fresh_network_trusts_the_measurement_at_every_pixel() -> None:
    evidence = torch.zeros(1, CHANNELS, 16, 24)
    block = evidence[:, 4 * CHANGE : 4 * CHANGE + 4]
    block[:] = torch.rand(block.shape)
    change, log_sigma = FusionNet(CHANNELS, 4 * CHANGE).eval()(evidence)
    measured = torch.nn.functional.pixel_shuffle(block, 2)[:, 0]
    torch.testing.assert_close(
        change / measured, torch.full_like(measured, torch.sigmoid(torch.tensor(3.0)).item())
    )
    assert log_sigma.shape == change.shape == (1, 32, 48)
