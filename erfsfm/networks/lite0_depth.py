"""Disparity from one image by an EfficientNet-Lite0 encoder and a plain or wide-field decoder."""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from erfsfm.networks.blocks import ConvBlock, Layer, Variant, crop_like, initialise, scaled
from erfsfm.networks.depth_net import FIRST_LOGIT, DisparityHead
from erfsfm.networks.lite0 import CHANNELS, SKIP_CHANNELS, SKIPS, Lite0Encoder

_DECODER_CHANNELS = (128, 64, 48, 32, 16)  # at 1/32 (the encoder's context), then before each doubling
_SCALES = 4
_WIDE_LEVELS = 2  # of the decoder, the coarsest, with deformable convolutions in the wide-field variant


class Lite0DepthNet(nn.Module):
    """Encoder-decoder with skip connections and four disparity heads.

    The ``dfc`` variant has the paper's deformable convolutions where a map is coarse: the encoder's last layer, at
    1/32, and the decoder's convolutions at 1/16 and 1/8. They start as plain ones.
    """

    def __init__(self, variant: Variant = "plain", width: float = 1.0) -> None:
        super().__init__()
        self.variant = variant
        self.fidelity = "default"
        channels = [scaled(count, width) for count in _DECODER_CHANNELS]
        deformable = variant == "dfc"
        wide = Layer(3, 1, deformable=deformable)
        context = ConvBlock(CHANNELS, channels[0], wide)
        self.encoder = Lite0Encoder(self.input_channels, context)
        skips = [*reversed(SKIP_CHANNELS), 0]  # 1/16 to 1/2; the image itself is not a skip
        before = nn.ModuleList()
        after = nn.ModuleList()
        inside = channels[0]
        for level, (count, skip) in enumerate(zip([*channels[1:], channels[-1]], skips)):
            before.append(ConvBlock(inside, count, Layer(3, 1)))
            layer = wide if level < _WIDE_LEVELS else Layer(3, 1)
            after.append(ConvBlock(count + skip, count, layer))
            inside = count
        self.reductions, self.fusions = before, after
        self.heads = nn.ModuleList(DisparityHead(count) for count in [*channels[1:], channels[-1]][-_SCALES:])
        initialise(self, "default")
        for head in self.heads:
            nn.init.constant_(cast(Tensor, head.bias), FIRST_LOGIT)

    @property
    def input_channels(self) -> int:
        """Channels of the encoder's input."""
        return 3

    def encoder_layers(self) -> list[Layer]:
        """Geometry of the encoder's convolutions wider than a pixel, first to last."""
        return self.encoder.layers()

    def forward(self, image: Tensor) -> list[Tensor] | Tensor:
        """Predict disparity, unscaled, in (0.01, 10.01); arguments and shapes are those of ``DepthNet``."""
        if image.dim() != 4 or image.shape[1] != 3:
            raise ValueError(f"image must have shape (B, 3, H, W); got {tuple(image.shape)}")
        stages = self.encoder(image)
        features = stages[-1]
        references: list[Tensor] = [*(stages[k] for k in reversed(SKIPS)), image]
        disparities: list[Tensor] = []
        for level, (reduce, fuse, reference) in enumerate(zip(self.reductions, self.fusions, references)):
            doubled = F.interpolate(reduce(features), scale_factor=2.0, mode="nearest")
            features = crop_like(doubled, reference)
            if reference is not image:
                features = torch.cat([features, reference], dim=1)
            features = fuse(features)
            head = level - len(self.fusions) + _SCALES
            if head >= 0 and (self.training or level == len(self.fusions) - 1):
                disparities.insert(0, self.heads[head](features))
        return disparities if self.training else disparities[0]
