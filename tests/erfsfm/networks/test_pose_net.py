import pytest
import torch

from erfsfm.networks.pose_net import PoseNet

VARIANTS = ["plain", "dilated", "dfc", "dfcv2"]


def images(count, size=(32, 48), batch=2):
    torch.manual_seed(0)
    target, *sources = (torch.rand(batch, 3, *size) * 2 - 1 for _ in range(count + 1))
    return target, sources


def stage_sizes(network, size):
    stages = network.encoder(torch.zeros(1, network.input_channels, *size))
    return [tuple(stage.shape[2:]) for stage in stages]


PLAIN_SIZES = [(64, 208), (32, 104), (16, 52), (8, 26), (4, 13), (2, 7), (1, 4)]
PAPER_DILATED_SIZES = [(61, 205), (29, 101), (14, 50), (6, 24), (3, 12), (2, 6), (1, 3)]


@pytest.mark.parametrize(
    "variant, fidelity, wanted",
    [
        ("plain", "paper", PLAIN_SIZES),
        ("plain", "default", PLAIN_SIZES),
        ("dilated", "default", PLAIN_SIZES),
        ("dilated", "paper", PAPER_DILATED_SIZES),
        ("dfc", "default", PLAIN_SIZES),
        ("dfcv2", "default", PLAIN_SIZES),
    ],
)
def test_stage_sizes(variant, fidelity, wanted):
    assert stage_sizes(PoseNet(variant, fidelity, width=0.1), (128, 416)) == wanted


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("normalisation", ["none", "batch"])
def test_every_weight_has_a_gradient(variant, normalisation):
    network = PoseNet(variant, width=0.5, sources=2, normalisation=normalisation)
    network(*images(2, (130, 161))).sum().backward()
    silent = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert not silent
