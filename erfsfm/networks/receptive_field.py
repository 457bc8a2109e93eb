"""Receptive field of a network's encoder, in theory and by gradients, and the cost of a forward pass.

The paper compares its networks by the receptive field of one pixel of the last encoder layer (its figure 4).
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from erfsfm.networks.blocks import Encoder, Layer
from erfsfm.networks.deformable import DeformableConv2d
from erfsfm.networks.depth_net import DisparityNetwork
from erfsfm.networks.pose_net import PoseNet

Network = DisparityNetwork | PoseNet

# Gradients below this ratio of the largest are rounding of the sampling positions in float64.
_ROUNDING = 1e-11


@dataclass(frozen=True)
class MeasuredField:
    """The image pixels that influence one output pixel, by input gradients.

    Attributes:
        pixel: (row, column) of the output pixel in the last encoder layer.
        top: first image row with a gradient; so is `left` the first column.
        rows: height of the bounding box, 0 for an empty field.
        columns: width of it.
        coverage: fraction of the image's pixels with a gradient.
        gradient: gradient magnitude summed over the input channels, ``(H, W)``.
    """

    pixel: tuple[int, int]
    top: int
    left: int
    rows: int
    columns: int
    coverage: float
    gradient: Tensor

    def share_holding(self, weight: float) -> float:
        """Least fraction of the image's pixels that holds this fraction of the gradient; 0 for an empty field."""
        total = self.gradient.double().flatten().sort(descending=True).values.cumsum(0)
        if total[-1] == 0:
            return 0.0
        return float((total < weight * total[-1]).double().mean()) + 1 / len(total)


def theoretical(network: Network, offsets_px: float = 0.0) -> int:
    """Side of the receptive field after the last encoder layer in pixels.

    r = r_0 + 2 ceil(o) sum_i j_i        over the deformable layers i, j_i the jump of their input

    Args:
        network: any depth or pose network.
        offsets_px: largest outward offset of deformable taps, in pixels of the layer's input; a fraction of a
            pixel reads the next one, too.
    """
    layers = network.encoder.layers()
    moving = sum(jump for layer, jump in zip(layers, _jumps(layers)) if layer.deformable)
    return field_after(layers) + 2 * math.ceil(offsets_px) * moving


def theoretical_corner(
    network: Network, pixel: tuple[int, int], offsets_px: float = 0.0
) -> tuple[int, int]:
    """Image row and column of the top-left corner of a field of `theoretical` side; outside the image too.

    Args:
        network: any depth or pose network.
        pixel: (row, column) of the observed output in the last encoder layer.
        offsets_px: as for `theoretical`.
    """
    layers = network.encoder.layers()
    jumps = _jumps(layers)
    reach = 0
    for block, jump in zip(network.encoder.blocks(), jumps):
        reach += jump * block.padding
    reach += (theoretical(network, offsets_px) - field_after(layers)) // 2
    step = jumps[-1] * layers[-1].stride
    return pixel[0] * step - reach, pixel[1] * step - reach


def field_after(layers: Sequence[Layer]) -> int:
    """Side of the receptive field after some layers in pixels.

    r += (k - 1) d j;  j *= s        with the jump j of the layer's input in pixels
    """
    return 1 + sum(
        (layer.kernel - 1) * layer.dilation * jump for layer, jump in zip(layers, _jumps(layers))
    )


def _jumps(layers: Sequence[Layer]) -> list[int]:
    """Distance in image pixels of neighbouring inputs of each layer."""
    return [math.prod(before.stride for before in layers[:i]) for i in range(len(layers))]


def measured(
    network: Network,
    size: tuple[int, int] = (128, 416),
    pixel: tuple[int, int] | None = None,
    offsets_px: float = 0.0,
) -> MeasuredField:
    """Bounding box and coverage by input gradients, with constant positive weights and a white image.

    Args:
        network: any depth or pose network.
        size: image (height, width).
        pixel: (row, column) of the observed output; its map's centre if None.
        offsets_px: how far deformable taps are pushed outwards from the kernel's centre, along both
            axes, in pixels of the layer's input.
    """
    return field_of(*_evenly_weighted(network, size, offsets_px), pixel, _ROUNDING)


def share_read(network: Network, size: tuple[int, int], offsets_px: float = 0.0) -> float:
    """Fraction of the image's pixels in the field of any output of the last encoder layer; arguments as `measured`."""
    encoder, image = _evenly_weighted(network, size, offsets_px)
    image.requires_grad_()
    (gradient,) = torch.autograd.grad(
        encoder(image)[-1].sum(), image
    )  # of positive terms: none cancel
    return float((gradient > 0).any(dim=1).double().mean())


def _evenly_weighted(
    network: Network, size: tuple[int, int], offsets_px: float
) -> tuple[Encoder, Tensor]:
    """A copy of the encoder with constant positive weights, and a white image for it.

    Weights are one over the fan-in, so that no activation overflows.
    """
    encoder = copy.deepcopy(network.encoder).double().eval()
    for module in encoder.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.reset_running_stats()
            module.reset_parameters()
        elif isinstance(module, nn.ReLU6):
            module.max_val = math.inf  # a white image saturates it
    predictors: set[nn.Module] = set()  # of offsets, which are fixed
    for module in encoder.modules():
        if not isinstance(module, DeformableConv2d):
            continue
        predictors |= {module.offset, module.modulator}
        module.reset_offsets()
        side = module.kernel.kernel_size[0]
        outwards = torch.sign(torch.arange(side) - (side - 1) / 2) * offsets_px
        taps = torch.stack(
            torch.meshgrid(outwards, outwards, indexing="ij"), dim=-1
        )  # (k, k, [dy, dx])
        assert module.offset.bias is not None
        with torch.no_grad():
            module.offset.bias.copy_(taps.flatten())
    for module in encoder.modules():
        if isinstance(module, nn.Conv2d) and module not in predictors:
            nn.init.constant_(module.weight, 1 / module.weight[0].numel())
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    device = next(encoder.parameters()).device
    return encoder, torch.ones(1, network.input_channels, *size, dtype=torch.float64, device=device)


def field_of(
    encoder: Encoder, image: Tensor, pixel: tuple[int, int] | None = None, rounding: float = 0.0
) -> MeasuredField:
    """Field of one pixel of an encoder's output, by input gradients of the sum of its channels.

    All channels, since a single one may be zero behind its ReLU. Of an encoder as it is, its weights and offsets
    included, this is the gradient-weighted effective field (Luo et al. 2016).

    Args:
        encoder: in evaluation mode.
        image: its input, ``(1, C, H, W)``; of a pose network target and sources stacked.
        pixel: (row, column) of the observed output; its map's centre if None.
        rounding: ratio to the largest gradient up to which a gradient counts as zero.
    """
    image = image.detach().clone().requires_grad_()
    output = encoder(image)[-1]
    row, column = pixel or (output.shape[2] // 2, output.shape[3] // 2)
    (gradient,) = torch.autograd.grad(output[0, :, row, column].sum(), image)
    gradient = gradient[0].abs().sum(dim=0)  # (H, W)
    seen = gradient > rounding * gradient.max()
    top, rows = _extent(seen.any(dim=1))
    left, columns = _extent(seen.any(dim=0))
    coverage = float(seen.double().mean())
    return MeasuredField((row, column), top, left, rows, columns, coverage, gradient)


def multiply_adds(network: Network, height: int = 128, width: int = 416) -> int:
    """Multiply-adds of one forward pass in evaluation mode: convolutions of every kind, no sampling.

    The network is copied to the meta device, so that only shapes are computed.

    Raises:
        ConfigError: if the network cannot run forward.
    """
    shadow = copy.deepcopy(network).to("meta").eval()
    image = torch.empty(1, 3, height, width, device="meta")
    images = (image, [image] * shadow.sources) if isinstance(shadow, PoseNet) else (image,)
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        shadow(*images)
    return int(counter.get_total_flops()) // 2


def _extent(seen: Tensor) -> tuple[int, int]:
    """First true place, and how many there are up to the last; zeros if there is none."""
    places = seen.nonzero()[:, 0]
    return (int(places[0]), int(places[-1] - places[0]) + 1) if len(places) else (0, 0)
