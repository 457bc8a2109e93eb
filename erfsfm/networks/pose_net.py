"""Camera motion between a target image and its sources: PoseNet (Zhou et al. 2017) and variants."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from erfsfm.networks.blocks import (
    ConvBlock,
    Encoder,
    Fidelity,
    Layer,
    Normalisation,
    Variant,
    initialise,
    scaled,
)

POSE_SCALE = 0.01

_KERNELS = (7, 5, 3, 3, 3, 3, 3)
_ENCODER_CHANNELS = (16, 32, 64, 128, 256, 256, 256)
_DILATED_STAGES = (0, 1, 2, 3)
_DEFORMABLE_STAGES: dict[Variant, tuple[int, ...]] = {"dfc": (2, 3, 4, 5, 6), "dfcv2": (0, 1, 2, 3)}


class PoseNet(nn.Module):
    """Seven strided convolutions, a 1 x 1 convolution and a mean over the map.

    Variants: ``dilated`` conv1-4; ``dfc`` conv3-7 and ``dfcv2`` conv1-4 deformable.

    The paper dilates by 2 in layers of stride 2. All taps of all outputs then fall on the same parity:
    three quarters of the image, and of the next two maps, are never read. By default we dilate by 3
    instead: a dilation coprime to the stride visits every pixel, at the same parameters and cost, and
    the field grows further (339 px; paper 301, plain 263). The padding grows with it, so that all maps
    keep the plain network's sizes.
    """

    def __init__(
        self,
        variant: Variant = "plain",
        fidelity: Fidelity = "default",
        width: float = 1.0,
        sources: int = 4,
        normalisation: Normalisation = "none",
    ) -> None:
        super().__init__()
        self.sources = sources
        channels = [scaled(count, width) for count in _ENCODER_CHANNELS]
        stages = []
        for stage, (kernel, inside, outside) in enumerate(
            zip(_KERNELS, [self.input_channels, *channels], channels)
        ):
            dilation = 1
            if variant == "dilated" and stage in _DILATED_STAGES:
                dilation = 2 if fidelity == "paper" else 3  # 3 is coprime to the stride, see above
            layer = Layer(
                kernel, 2, dilation, deformable=stage in _DEFORMABLE_STAGES.get(variant, ())
            )
            stages.append([ConvBlock(inside, outside, layer, fidelity, normalisation)])
        self.encoder = Encoder(stages)
        self.pose_head = nn.Conv2d(channels[-1], 6 * sources, 1)
        initialise(self, fidelity)

    @property
    def input_channels(self) -> int:
        """Channels of the encoder's input: the target and its sources, stacked."""
        return 3 * (1 + self.sources)

    def forward(self, target: Tensor, sources: Sequence[Tensor]) -> Tensor:
        """Predict the motion from the target camera to each source camera.

        Args:
            target: colours in [-1, 1], ``(B, 3, H, W)``.
            sources: N images like the target, in time order.

        Returns:
            ``T_source_target`` as translation (unscaled) and XYZ Euler angles (radians),
            (tx, ty, tz, rx, ry, rz), ``(B, N, 6)``.
        """
        stages = self.encoder(torch.cat([target, *sources], dim=1))
        pooled: Tensor = self.pose_head(stages[-1]).mean(dim=(2, 3))  # (B, 6 * N)
        return POSE_SCALE * pooled.view(-1, self.sources, 6)
