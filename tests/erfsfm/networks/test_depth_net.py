import pytest
import torch

from erfsfm.common.errors import ConfigError
from erfsfm.networks.depth_net import DepthNet

VARIANTS = ["plain", "dilated", "dfc", "dfcv2"]


def sizes(outputs):
    return [tuple(output.shape[2:]) for output in outputs]


@pytest.mark.parametrize(
    "pyramid",
    [
        [(128, 416), (64, 208), (32, 104), (16, 52)],
        [(75, 248), (38, 124), (19, 62), (10, 31)],
        [(94, 310), (47, 155), (24, 78), (12, 39)],
        [(188, 620), (94, 310), (47, 155), (24, 78)],
        [(376, 1241), (188, 621), (94, 311), (47, 156)],
    ],
)
def test_pyramid_sizes_of_the_paper(pyramid):
    assert sizes(DepthNet(width=0.05)(torch.zeros(1, 3, *pyramid[0]))) == pyramid


@pytest.mark.parametrize("variant", VARIANTS)
def test_evaluation_gives_the_finest_alone(variant):
    torch.manual_seed(0)
    network = DepthNet(variant, width=0.1)
    image = torch.rand(2, 3, 40, 56) * 2 - 1
    disparities = network(image)
    alone = network.eval()(image)
    assert isinstance(alone, torch.Tensor)
    torch.testing.assert_close(alone, disparities[0])


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("normalisation", ["none", "batch"])
def test_every_weight_has_a_gradient(variant, normalisation):
    torch.manual_seed(0)
    network = DepthNet(variant, width=0.1, normalisation=normalisation)
    image = torch.rand(2, 3, 129, 67) * 2 - 1
    loss = sum((disparity * torch.rand_like(disparity)).mean() for disparity in network(image))
    loss.backward()
    silent = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert not silent


def test_paper_dilated_builds_and_refuses_to_run():
    network = DepthNet("dilated", "paper", width=0.05)
    with pytest.raises(ConfigError, match="erf-depthnet-dilated cannot run in paper fidelity"):
        network(torch.zeros(1, 3, 128, 416))
