import pytest
from torch import nn

from erfsfm.networks.blocks import ConvBlock, Layer


@pytest.mark.parametrize("deformable", [False, True])
def test_batch_norm_sits_between_convolution_and_relu(deformable):
    block = ConvBlock(2, 4, Layer(3, 1, deformable=deformable), normalisation="batch")
    assert [type(module) for module in block][1:] == [nn.BatchNorm2d, nn.ReLU]
    plain = ConvBlock(2, 4, Layer(3, 1, deformable=deformable))
    difference = sum(p.numel() for p in block.parameters()) - sum(
        p.numel() for p in plain.parameters()
    )
    assert difference == 8
