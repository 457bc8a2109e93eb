"""Camera motion between a target image and its sources by an EfficientNet-Lite0 encoder."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from erfsfm.networks.blocks import ConvBlock, Layer, Variant, initialise, scaled
from erfsfm.networks.lite0 import CHANNELS, Lite0Encoder
from erfsfm.networks.pose_net import pose_vectors, stack_images

_CHANNELS = 256


class Lite0PoseNet(nn.Module):
    """The encoder on the stacked images, two 3 x 3 convolutions at 1/32, a 1 x 1 convolution and a mean over the map.

    The ``dfc`` variant has deformable 3 x 3 convolutions, the paper's way to a wider field.
    """

    def __init__(self, variant: Variant = "plain", width: float = 1.0, sources: int = 4) -> None:
        super().__init__()
        self.variant = variant
        self.fidelity = "default"
        self.sources = sources
        count = scaled(_CHANNELS, width)
        layer = Layer(3, 1, deformable=variant == "dfc")
        context = [
            ConvBlock(CHANNELS, count, layer),
            ConvBlock(count, count, layer),
        ]
        self.encoder = Lite0Encoder(self.input_channels, context)
        self.pose_head = nn.Conv2d(count, 6 * sources, 1)
        self.mask_decoder = None
        initialise(self, "default")

    @property
    def input_channels(self) -> int:
        """Channels of the encoder's input: the target and its sources, stacked."""
        return 3 * (1 + self.sources)

    def encoder_layers(self) -> list[Layer]:
        """Geometry of the encoder's convolutions wider than a pixel, first to last."""
        return self.encoder.layers()

    def forward(self, target: Tensor, sources: Sequence[Tensor]) -> Tensor:
        """Predict the motion from the target camera to each source camera; arguments are those of ``PoseNet``."""
        stack = stack_images(target, sources, self.sources)
        return pose_vectors(self.pose_head(self.encoder(stack)[-1]), self.sources)
