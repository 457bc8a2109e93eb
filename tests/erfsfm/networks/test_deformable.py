import itertools
import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from erfsfm.networks import deformable
from erfsfm.networks.blocks import initialise
from erfsfm.networks.deformable import DeformableConv2d, deform_conv2d


def bilinear(image: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """Value of a (C, H, W) image at one place, zero outside."""
    height, width = image.shape[1:]
    top, left = math.floor(y.item()), math.floor(x.item())
    value = torch.zeros(image.shape[0], dtype=image.dtype)
    for row, column in itertools.product((top, top + 1), (left, left + 1)):
        if 0 <= row < height and 0 <= column < width:
            value = value + (1 - (y - row).abs()) * (1 - (x - column).abs()) * image[:, row, column]
    return value


def reference(input, offset, weight, bias, stride, padding, dilation, mask):
    """The definition, one tap at a time."""
    batch, channels = input.shape[:2]
    out_channels, inside, k_h, k_w = weight.shape
    taps = k_h * k_w
    offset_groups = offset.shape[1] // (2 * taps)
    out_h, out_w = offset.shape[2:]
    results = []
    for b, i, j in itertools.product(range(batch), range(out_h), range(out_w)):
        columns = []
        for group in range(offset_groups):
            size = channels // offset_groups
            image = input[b, group * size : (group + 1) * size]
            for tap in range(taps):
                dy, dx = offset[b, 2 * (group * taps + tap) : 2 * (group * taps + tap) + 2, i, j]
                y = i * stride[0] - padding[0] + tap // k_w * dilation[0] + dy
                x = j * stride[1] - padding[1] + tap % k_w * dilation[1] + dx
                columns.append(mask[b, group * taps + tap, i, j] * bilinear(image, y, x))
        read = (
            torch.stack(columns)
            .view(offset_groups, taps, -1)
            .permute(0, 2, 1)
            .reshape(channels, taps)
        )
        groups = channels // inside
        parts = [
            w.flatten(1) @ r.flatten()
            for w, r in zip(weight.chunk(groups), read.view(groups, inside, taps))
        ]
        results.append(torch.cat(parts) + bias)
    return torch.stack(results).view(batch, out_h, out_w, out_channels).permute(0, 3, 1, 2)


def make_case(size, kernel, stride, padding, dilation, offset_groups, weight_groups, reach, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    out = [
        (n + 2 * p - d * (k - 1) - 1) // s + 1
        for n, k, s, p, d in zip(size, kernel, stride, padding, dilation)
    ]
    taps = kernel[0] * kernel[1]
    tensors = {
        "input": draw(2, 4, *size),
        "offset": reach * draw(2, 2 * offset_groups * taps, *out),
        "weight": draw(6, 4 // weight_groups, *kernel),
        "bias": draw(6),
        "mask": draw(2, offset_groups * taps, *out).sigmoid(),
    }
    return {name: tensor.requires_grad_() for name, tensor in tensors.items()}


# size, kernel, stride, padding, dilation, offset groups, weight groups, reach of the offsets in pixels
CASES = [
    ((5, 6), (3, 3), (1, 1), (1, 1), (1, 1), 1, 1, 1.0),
    ((6, 5), (3, 3), (2, 2), (1, 1), (1, 1), 2, 1, 0.3),
    ((7, 7), (3, 2), (2, 1), (0, 2), (2, 1), 1, 2, 1.0),
    ((5, 5), (3, 3), (1, 2), (2, 2), (2, 2), 4, 2, 2.0),
    ((4, 4), (3, 3), (1, 1), (1, 1), (1, 1), 1, 1, 8.0),  # mostly outside
    ((1, 5), (3, 3), (2, 2), (1, 1), (1, 1), 1, 1, 0.7),
    ((4, 1), (3, 3), (1, 1), (1, 1), (1, 1), 1, 1, 0.7),
    ((1, 1), (3, 3), (1, 1), (1, 1), (1, 1), 2, 2, 0.7),
    ((4, 5), (1, 1), (1, 1), (0, 0), (1, 1), 1, 1, 1.0),
]


@pytest.mark.parametrize("case", CASES)
def test_values_and_gradients_equal_the_definition(case, monkeypatch):
    """Some outputs at a time, and all in one piece where they are few."""
    monkeypatch.setattr(deformable, "_CPU_CHUNK", 50)
    stride, padding, dilation = case[2:5]
    tensors = make_case(*case)
    ours = deform_conv2d(**tensors, stride=stride, padding=padding, dilation=dilation)
    wanted = reference(**tensors, stride=stride, padding=padding, dilation=dilation)
    torch.testing.assert_close(ours, wanted, rtol=1e-10, atol=1e-10)
    upstream = torch.randn_like(wanted)
    gradients = torch.autograd.grad(ours, list(tensors.values()), upstream)
    wanted_gradients = torch.autograd.grad(wanted, list(tensors.values()), upstream)
    for name, ours_one, wanted_one in zip(tensors, gradients, wanted_gradients):
        torch.testing.assert_close(ours_one, wanted_one, rtol=1e-8, atol=1e-9, msg=name)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-10), (torch.float32, 2e-3)])
@pytest.mark.parametrize(
    "stride, padding, dilation", [(1, 1, 1), (2, 1, 1), ((2, 1), (0, 3), (1, 2))]
)
def test_zero_offsets_and_unit_mask_are_plain_convolution(
    stride, padding, dilation, dtype, tolerance
):
    features, weight, bias = torch.randn(2, 4, 37, 101), torch.randn(6, 2, 3, 3), torch.randn(6)
    features, weight, bias = features.to(dtype), weight.to(dtype), bias.to(dtype)
    plain = F.conv2d(features, weight, bias, stride, padding, dilation, groups=2)
    offset = torch.zeros(2, 18, *plain.shape[2:], dtype=dtype)
    mask = torch.ones(2, 9, *plain.shape[2:], dtype=dtype)
    for factors in (None, mask):
        ours = deform_conv2d(features, offset, weight, bias, stride, padding, dilation, factors)
        torch.testing.assert_close(ours, plain, rtol=0, atol=tolerance)


def test_layer_starts_as_a_plain_convolution_and_can_learn_offsets():
    torch.manual_seed(0)
    layer = DeformableConv2d(4, 5, kernel=3, stride=2, padding=1)
    initialise(layer, "default")
    features = torch.randn(2, 4, 9, 11)
    output = layer(features)
    torch.testing.assert_close(output, layer.kernel(features), rtol=0, atol=1e-4)
    output.square().sum().backward()
    for convolution in (layer.offset, layer.modulator):
        assert convolution.weight.grad is not None and convolution.weight.grad.abs().sum() > 0
