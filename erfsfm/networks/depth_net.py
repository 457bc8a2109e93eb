"""Disparity from one image: DispNet (Zhou et al. 2017) and its wide-field variants."""

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from erfsfm.common.errors import ConfigError
from erfsfm.networks.blocks import (
    ConvBlock,
    Encoder,
    Fidelity,
    Layer,
    Normalisation,
    UpBlock,
    Variant,
    crop_like,
    initialise,
    scaled,
)

MAX_DISPARITY = 10.0
MIN_DISPARITY = 0.01

_KERNELS = (7, 5, 3, 3, 3, 3, 3)
_ENCODER_CHANNELS = (32, 64, 128, 256, 512, 512, 512)
_DECODER_CHANNELS = (512, 512, 256, 128, 64, 32, 16)  # level 7 to level 1
_SCALES = 4
FIRST_LOGIT = -2.0  # disparity 1.2, where the logarithm of a sigmoid has a large slope
_DILATED_STAGES = (0, 1)
_DEFORMABLE_STAGES: dict[Variant, tuple[int, ...]] = {"dfc": (0, 1, 2, 3), "dfcv2": (3, 4, 5, 6)}


class DisparityHead(nn.Conv2d):
    """Features to disparity in (0.01, 10.01), in single precision under autocast: bfloat16 has some 300 such values."""

    def __init__(self, in_channels: int, out_channels: int = 1) -> None:
        super().__init__(in_channels, out_channels, 3, padding=1)

    def forward(self, features: Tensor) -> Tensor:
        """``(B, C, H, W)`` to ``(B, out_channels, H, W)``."""
        kind = features.device.type
        if torch.amp.is_autocast_available(kind) and torch.is_autocast_enabled(kind):
            with torch.autocast(kind, enabled=False):
                return self.forward(features.float())
        return MAX_DISPARITY * torch.sigmoid(super().forward(features)) + MIN_DISPARITY


class DisparityNetwork(nn.Module):
    """An encoder and a decoder with four disparity heads."""

    input_channels = 3  # of the encoder
    encoder: Encoder

    def decode(self, image: Tensor, stages: list[Tensor]) -> list[Tensor]:
        """Disparities, finest first, from the outputs of the encoder's stages; in evaluation mode one suffices."""
        raise NotImplementedError

    def forward(self, image: Tensor) -> list[Tensor] | Tensor:
        """Predict disparity, unscaled, in (0.01, 10.01).

        Args:
            image: colours in [-1, 1], ``(B, 3, H, W)``; any size.

        Returns:
            In training mode four disparities, finest first, ``(B, 1, ceil(H / 2^s), ceil(W / 2^s))``;
            in evaluation mode the finest alone, ``(B, 1, H, W)``.
        """
        disparities = self.decode(image, self.encoder(image))
        return disparities if self.training else disparities[0]


class DepthNet(DisparityNetwork):
    """Encoder-decoder with skip connections and four disparity heads.

    Variants change both convolutions of some encoder stages: ``dilated`` conv1-2 (dilation 2), ``dfc``
    conv1-4 and ``dfcv2`` conv4-7 (deformable). In paper fidelity the dilated maps shrink below what the
    decoder needs at every image size: that network builds, and its forward raises one error. By
    default the padding grows; conv1's first layer then still reads every second row and column of the
    image, as stride 2 with dilation 2 does.
    """

    def __init__(
        self,
        variant: Variant = "plain",
        fidelity: Fidelity = "default",
        width: float = 1.0,
        normalisation: Normalisation = "none",
    ) -> None:
        super().__init__()
        self._runs = (variant, fidelity) != ("dilated", "paper")
        encoder = [scaled(channels, width) for channels in _ENCODER_CHANNELS]
        decoder = [scaled(channels, width) for channels in _DECODER_CHANNELS]
        stages = []
        for stage, (kernel, inside, outside) in enumerate(zip(_KERNELS, [3, *encoder], encoder)):
            dilation = 2 if variant == "dilated" and stage in _DILATED_STAGES else 1
            deformable = stage in _DEFORMABLE_STAGES.get(variant, ())
            down, same = (Layer(kernel, stride, dilation, deformable) for stride in (2, 1))
            blocks = ((inside, down), (outside, same))
            stages.append(
                [
                    ConvBlock(count, outside, layer, fidelity, normalisation)
                    for count, layer in blocks
                ]
            )
        self.encoder = Encoder(stages)
        skips = [*reversed(encoder[:-1]), 0]  # level 7 to level 1; the image itself is not a skip
        coarser = [int(level >= len(decoder) - _SCALES + 1) for level in range(len(decoder))]
        self.upconvs = nn.ModuleList(
            UpBlock(inside, outside, 3, normalisation)
            for inside, outside in zip([encoder[-1], *decoder], decoder)
        )
        self.iconvs = nn.ModuleList(
            ConvBlock(up + skip + disparity, up, Layer(3, 1), fidelity, normalisation)
            for up, skip, disparity in zip(decoder, skips, coarser)
        )
        self.heads = nn.ModuleList(DisparityHead(channels) for channels in decoder[-_SCALES:])
        initialise(self, fidelity)
        if fidelity == "default":
            for head in self.heads:
                nn.init.constant_(cast(Tensor, head.bias), FIRST_LOGIT)

    def forward(self, image: Tensor) -> list[Tensor] | Tensor:
        """As any disparity network.

        Raises:
            ConfigError: for the dilated network in paper fidelity, which fits no image.
        """
        if not self._runs:
            raise ConfigError(
                "erf-depthnet-dilated cannot run in paper fidelity: its maps shrink; use 'default'"
            )
        return super().forward(image)

    def decode(self, image: Tensor, stages: list[Tensor]) -> list[Tensor]:
        """From the coarsest level to the finest, with the encoder's outputs and the coarser disparity."""
        features = stages[-1]
        disparities: list[Tensor] = []
        references = [*reversed(stages[:-1]), image]
        for level, (upconv, iconv, reference) in enumerate(
            zip(self.upconvs, self.iconvs, references)
        ):
            parts = [crop_like(upconv(features), reference)]
            if reference is not image:
                parts.append(reference)
            if disparities:
                coarser = F.interpolate(
                    disparities[0], scale_factor=2, mode="bilinear", align_corners=False
                )
                parts.append(crop_like(coarser, reference))
            features = iconv(torch.cat(parts, dim=1))
            head = level - len(self.upconvs) + _SCALES
            if head >= 0:
                disparities.insert(0, self.heads[head](features))
        return disparities
