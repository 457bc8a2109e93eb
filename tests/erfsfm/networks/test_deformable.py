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


def reference(input, offset, weight, mask, stride, padding):
    """The definition, one tap at a time."""
    batch, kernel = len(input), weight.shape[-1]
    out_h, out_w = offset.shape[2:]
    results = []
    for b, i, j in itertools.product(range(batch), range(out_h), range(out_w)):
        columns = []
        for tap in range(kernel**2):
            dy, dx = offset[b, 2 * tap : 2 * tap + 2, i, j]
            y = i * stride - padding + tap // kernel + dy
            x = j * stride - padding + tap % kernel + dx
            columns.append(mask[b, tap, i, j] * bilinear(input[b], y, x))
        results.append(weight.flatten(1) @ torch.stack(columns, dim=1).flatten())
    return torch.stack(results).view(batch, out_h, out_w, -1).permute(0, 3, 1, 2)


def make_case(size, kernel, stride, padding, reach):
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    out = [(n + 2 * padding - kernel) // stride + 1 for n in size]
    tensors = {
        "input": draw(2, 4, *size),
        "offset": reach * draw(2, 2 * kernel**2, *out),
        "weight": draw(6, 4, kernel, kernel),
        "mask": draw(2, kernel**2, *out).sigmoid(),
    }
    return {name: tensor.requires_grad_() for name, tensor in tensors.items()}


# size, kernel, stride, padding, reach of the offsets in pixels
CASES = [
    ((5, 6), 3, 1, 1, 1.0),
    ((6, 5), 3, 2, 1, 0.3),
    ((7, 7), 3, 2, 0, 1.0),
    ((5, 5), 5, 1, 2, 2.0),
    ((4, 4), 3, 1, 1, 8.0),  # mostly outside
    ((1, 5), 3, 2, 1, 0.7),
    ((4, 1), 3, 1, 1, 0.7),
    ((1, 1), 3, 1, 1, 0.7),
    ((4, 5), 1, 1, 0, 1.0),
]


@pytest.mark.parametrize("case", CASES)
def test_values_and_gradients_equal_the_definition(case, monkeypatch):
    """Some outputs at a time, and all in one piece where they are few."""
    monkeypatch.setattr(deformable, "_CPU_CHUNK", 50)
    tensors = make_case(*case)
    ours = deform_conv2d(**tensors, stride=case[2], padding=case[3])
    wanted = reference(**tensors, stride=case[2], padding=case[3])
    torch.testing.assert_close(ours, wanted, rtol=1e-10, atol=1e-10)
    upstream = torch.randn_like(wanted)
    gradients = torch.autograd.grad(ours, list(tensors.values()), upstream)
    wanted_gradients = torch.autograd.grad(wanted, list(tensors.values()), upstream)
    for name, ours_one, wanted_one in zip(tensors, gradients, wanted_gradients):
        torch.testing.assert_close(ours_one, wanted_one, rtol=1e-8, atol=1e-9, msg=name)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-10), (torch.float32, 2e-3)])
@pytest.mark.parametrize("stride", [1, 2])
def test_zero_offsets_and_unit_mask_are_plain_convolution(stride, dtype, tolerance):
    features, weight = torch.randn(2, 4, 37, 101, dtype=dtype), torch.randn(6, 4, 3, 3, dtype=dtype)
    plain = F.conv2d(features, weight, None, stride, 1)
    offset, mask = plain.new_zeros(2, 18, *plain.shape[2:]), plain.new_ones(2, 9, *plain.shape[2:])
    ours = deform_conv2d(features, offset, weight, mask, stride, 1)
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
