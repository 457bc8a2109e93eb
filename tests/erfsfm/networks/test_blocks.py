import pytest
import torch
from torch import nn

from erfsfm.networks.blocks import ConvBlock, Layer
from erfsfm.networks.deformable import DeformableConv2d


@pytest.mark.parametrize("kernel", [3, 5, 7])
@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("dilation", [1, 2, 3])
def test_default_maps_do_not_depend_on_dilation(kernel, stride, dilation):
    block = ConvBlock(2, 4, Layer(kernel, stride, dilation))
    assert block(torch.zeros(1, 2, 30, 41)).shape == (1, 4, -(-30 // stride), -(-41 // stride))


def test_paper_maps_shrink_with_dilation():
    block = ConvBlock(2, 4, Layer(7, 2, 2), fidelity="paper")
    assert block(torch.zeros(1, 2, 128, 416)).shape == (1, 4, 61, 205)


def test_deformable_block_has_no_bias_on_its_kernel():
    block = ConvBlock(2, 4, Layer(3, 1, deformable=True))
    assert isinstance(block[0], DeformableConv2d)
    assert block[0].kernel.bias is None
    assert block[0].offset.out_channels == 18 and block[0].modulator.out_channels == 9


@pytest.mark.parametrize("deformable", [False, True])
def test_batch_norm_sits_between_convolution_and_relu(deformable):
    block = ConvBlock(2, 4, Layer(3, 1, deformable=deformable), normalisation="batch")
    assert [type(module) for module in block][1:] == [nn.BatchNorm2d, nn.ReLU]
    plain = ConvBlock(2, 4, Layer(3, 1, deformable=deformable))
    difference = sum(p.numel() for p in block.parameters()) - sum(
        p.numel() for p in plain.parameters()
    )
    assert difference == 8
