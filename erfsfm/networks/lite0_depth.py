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


class Lite0DepthNet(nn.Module):
    """Encoder-decoder with skip connections and four disparity heads.

    The decoder ends at half of the image's size: its last head gives the four pixels of a square as channels (Shi et
    al. 2016), because convolutions at full size took a quarter of the time. The ``dfc`` variant has the paper's
    deformable convolutions where a map is coarse: the encoder's last layer, at 1/32, and the decoder's at 1/16. They
    start as plain ones.
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
        self.reductions, self.fusions = nn.ModuleList(), nn.ModuleList()
        for inside, outside, skip in zip(channels, channels[1:], reversed(SKIP_CHANNELS)):  # 1/16 to 1/2
            self.reductions.append(ConvBlock(inside, outside, Layer(3, 1)))
            self.fusions.append(ConvBlock(outside + skip, outside, Layer(3, 1) if len(self.fusions) else wide))
        self.last = ConvBlock(channels[-1], channels[-1], Layer(3, 1))
        self.heads = nn.ModuleList(DisparityHead(count) for count in channels[2:])  # at 1/8 to 1/2
        self.full_head = DisparityHead(channels[-1], 4)
        initialise(self, "default")
        for head in [*self.heads, self.full_head]:
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
        disparities: list[Tensor] = []
        for level, (reduce, fuse, skip) in enumerate(zip(self.reductions, self.fusions, reversed(SKIPS))):
            doubled = F.interpolate(reduce(features), scale_factor=2.0, mode="nearest")
            features = fuse(torch.cat([crop_like(doubled, stages[skip]), stages[skip]], dim=1))
            if self.training and level > 0:
                disparities.insert(0, self.heads[level - 1](features))
        finest = crop_like(F.pixel_shuffle(self.full_head(self.last(features)), 2), image)
        return [finest, *disparities] if self.training else finest
