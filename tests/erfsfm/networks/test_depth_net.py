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


def test_disparity_lies_in_its_range():
    torch.manual_seed(0)
    network = DepthNet(width=0.1)
    for bias, wanted in [(-1e3, 0.01), (0.0, 5.01), (1e3, 10.01)]:
        for head in network.heads:
            torch.nn.init.zeros_(head.weight)
            torch.nn.init.constant_(head.bias, bias)
        for disparity in network(torch.rand(1, 3, 16, 16)):
            torch.testing.assert_close(disparity, torch.full_like(disparity, wanted))


def test_zero_offsets_start_as_the_plain_network():
    torch.manual_seed(0)
    deformable = DepthNet("dfcv2", width=0.1).eval()
    plain = DepthNet("plain", width=0.1).eval()
    weights = {
        name.replace(".kernel.weight", ".weight"): value
        for name, value in deformable.state_dict().items()
        if ".offset." not in name and ".modulator." not in name
    }
    missing = plain.load_state_dict(weights, strict=False)
    assert not missing.unexpected_keys
    assert all(name.endswith(".0.bias") for name in missing.missing_keys)  # zero in the plain one
    image = torch.rand(1, 3, 64, 96)
    torch.testing.assert_close(deformable(image), plain(image), rtol=0, atol=1e-4)


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
