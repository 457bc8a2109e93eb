"""The layers that the depth and pose networks share."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from torch import Tensor, nn

from erfsfm.config import Fidelity as Fidelity
from erfsfm.networks.deformable import DeformableConv2d

Normalisation = Literal["none", "batch"]
Activation = Literal["relu", "leaky"]
Variant = Literal["plain", "dilated", "dfc", "dfcv2"]


@dataclass(frozen=True)
class Layer:
    """Geometry of one encoder convolution; a deformable one is described at zero offsets."""

    kernel: int
    stride: int
    dilation: int = 1
    deformable: bool = False


class ConvBlock(nn.Sequential):
    """Convolution (plain, dilated or deformable), optional batch norm, ReLU.

    The plain convolution keeps its bias under batch norm: one layer list for both, and the parameter
    counts differ by the norms alone. In paper fidelity the padding does not grow with the dilation, so
    that dilated maps shrink.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        layer: Layer,
        fidelity: Fidelity = "default",
        normalisation: Normalisation = "none",
    ) -> None:
        padding = (layer.kernel - 1) // 2 * (1 if fidelity == "paper" else layer.dilation)
        convolution: nn.Module
        if layer.deformable:
            convolution = DeformableConv2d(
                in_channels, out_channels, layer.kernel, layer.stride, padding
            )
        else:
            convolution = nn.Conv2d(
                in_channels, out_channels, layer.kernel, layer.stride, padding, layer.dilation
            )
        super().__init__(convolution, *_activation(out_channels, normalisation))
        self.layer = layer
        self.padding = padding


class UpBlock(nn.Sequential):
    """Transposed convolution that doubles the map, optional batch norm, ReLU.

    Kernel 3 needs one row and column of output padding to double, kernel 4 doubles by itself.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel: Literal[3, 4],
        normalisation: Normalisation = "none",
    ) -> None:
        convolution = nn.ConvTranspose2d(
            in_channels, out_channels, kernel, stride=2, padding=1, output_padding=4 - kernel
        )
        super().__init__(convolution, *_activation(out_channels, normalisation))


class Encoder(nn.Module):
    """Stages of convolution blocks; every stage's output is kept for the decoder."""

    def __init__(self, stages: Sequence[Sequence[ConvBlock]]) -> None:
        super().__init__()
        self.stages = nn.ModuleList(nn.Sequential(*stage) for stage in stages)

    def forward(self, features: Tensor) -> list[Tensor]:
        """Outputs of all stages for ``(B, C, H, W)``, finest first."""
        outputs = []
        for stage in self.stages:
            features = stage(features)
            outputs.append(features)
        return outputs

    def layers(self) -> list[Layer]:
        """Geometry of the convolutions, first to last."""
        return [block.layer for block in self.blocks()]

    def blocks(self) -> Iterator[ConvBlock]:
        """Convolution blocks, first to last."""
        for stage in self.stages:
            for block in stage.children():
                assert isinstance(block, ConvBlock)
                yield block


def scaled(channels: int, width: float) -> int:
    """Number of hidden channels at a width multiplier, at least four."""
    return max(4, round(channels * width))


def crop_like(features: Tensor, reference: Tensor) -> Tensor:
    """Cut rows and columns at the bottom and right that `reference` does not have."""
    return features[..., : reference.shape[-2], : reference.shape[-1]]


def let_leak(network: nn.Module, slope: float = 0.1) -> None:
    """Turn every ReLU into a leaky one, as FlowNet and DispNet had them (Mayer et al. 2016).

    A narrow decoder has four channels at full resolution: where all ReLUs are zero, only a bias has a gradient.
    """
    for block in network.modules():
        if isinstance(block, ConvBlock | UpBlock):
            block[-1] = nn.LeakyReLU(slope, inplace=True)


def initialise(network: nn.Module, fidelity: Fidelity) -> None:
    """Xavier-uniform weights and zero biases in every convolution.

    In paper fidelity this includes the convolutions that predict offsets, as the published networks
    started; by default deformable layers start as plain ones.
    """
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.xavier_uniform_(module.weight)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    if fidelity == "default":
        for module in network.modules():
            if isinstance(module, DeformableConv2d):
                module.reset_offsets()


def _activation(channels: int, normalisation: Normalisation) -> list[nn.Module]:
    relu = nn.ReLU(inplace=True)
    return [nn.BatchNorm2d(channels), relu] if normalisation == "batch" else [relu]
