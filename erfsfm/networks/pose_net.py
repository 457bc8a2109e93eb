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
    UpBlock,
    Variant,
    crop_like,
    initialise,
    scaled,
)
from erfsfm.networks.image_alignment import Alignment, aligned

POSE_SCALE = 0.01

_KERNELS = (7, 5, 3, 3, 3, 3, 3)
_ENCODER_CHANNELS = (16, 32, 64, 128, 256, 256, 256)
_MASK_CHANNELS = (256, 128, 64, 32, 16)  # upconv5 to upconv1
_MASK_SCALES = 4
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
        mask_branch: bool = False,
        alignment: Alignment = "none",
    ) -> None:
        super().__init__()
        self.variant = variant
        self.fidelity = fidelity
        self.sources = sources
        self.alignment = alignment
        channels = [scaled(count, width) for count in _ENCODER_CHANNELS]
        self.encoder = Encoder(
            [
                [
                    ConvBlock(
                        inside,
                        outside,
                        _stage_layer(stage, kernel, variant, fidelity),
                        fidelity,
                        normalisation,
                    )
                ]
                for stage, (kernel, inside, outside) in enumerate(
                    zip(_KERNELS, [self.input_channels, *channels], channels)
                )
            ]
        )
        self.pose_head = nn.Conv2d(channels[-1], 6 * sources, 1)
        self.mask_decoder = MaskDecoder(channels[4], sources, width, normalisation) if mask_branch else None
        initialise(self, fidelity)

    @property
    def input_channels(self) -> int:
        """Channels of the encoder's input: the target and its sources, stacked."""
        return 3 * (1 + self.sources)

    def encoder_layers(self) -> list[Layer]:
        """Geometry of the encoder's convolutions, first to last."""
        return self.encoder.layers()

    def forward(self, target: Tensor, sources: Sequence[Tensor]) -> Tensor:
        """Predict the motion from the target camera to each source camera.

        Args:
            target: colours in [-1, 1], ``(B, 3, H, W)``.
            sources: N images like the target, in time order.

        Returns:
            ``T_source_target`` as translation (unscaled) and XYZ Euler angles (radians),
            (tx, ty, tz, rx, ry, rz), ``(B, N, 6)``. With alignment to the images, rotations are measured there; in
            training they are not.

        Raises:
            ValueError: if there are not N sources.
        """
        stages = self.encoder(stack_images(target, sources, self.sources))
        guess = pose_vectors(self.pose_head(stages[-1]), self.sources)
        return guess if self.training or self.alignment == "none" else aligned(guess, target, sources)

    def forward_with_masks(self, target: Tensor, sources: Sequence[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """Predict motions and the explainability mask of each source (Zhou et al. 2017, Section 3.3).

        Args:
            target: colours in [-1, 1], ``(B, 3, H, W)``.
            sources: N images like the target, in time order.

        Returns:
            What `forward` returns, and four masks in (0, 1), finest first, ``(B, N, h, w)``.

        Raises:
            ValueError: if there are not N sources, or the network has no mask branch.
        """
        if self.mask_decoder is None:
            raise ValueError("this pose network was built without a mask branch (mask_branch=False)")
        stack = stack_images(target, sources, self.sources)
        stages = self.encoder(stack)
        poses = pose_vectors(self.pose_head(stages[-1]), self.sources)
        return poses, self.mask_decoder(stages[4], [*reversed(stages[:4]), stack])


def stack_images(target: Tensor, sources: Sequence[Tensor], count: int) -> Tensor:
    """Target and `count` sources ``(B, 3, H, W)`` as one input ``(B, 3 * (1 + count), H, W)``."""
    check_images(target, sources, count)
    return torch.cat([target, *sources], dim=1)


def check_images(target: Tensor, sources: Sequence[Tensor], count: int) -> None:
    """Refuse images that are not a snippet.

    Raises:
        ValueError: another number of sources, or images of different shapes.
    """
    if len(sources) != count:
        raise ValueError(f"this pose network takes {count} sources; got {len(sources)}")
    for image in (target, *sources):
        if image.dim() != 4 or image.shape[1] != 3 or image.shape != target.shape:
            raise ValueError(
                "target and sources must have one shape (B, 3, H, W); "
                f"got {tuple(target.shape)} and {tuple(image.shape)}"
            )


def pose_vectors(features: Tensor, sources: int) -> Tensor:
    """Mean over the map ``(B, 6 * N, h, w)`` as pose vectors ``(B, N, 6)``."""
    pooled: Tensor = features.mean(dim=(2, 3))  # (B, 6 * N)
    return POSE_SCALE * pooled.view(-1, sources, 6)


class MaskDecoder(nn.Module):
    """Explainability masks from the fifth encoder map, one channel a source."""

    def __init__(self, in_channels: int, sources: int, width: float, normalisation: Normalisation) -> None:
        super().__init__()
        channels = [scaled(count, width) for count in _MASK_CHANNELS]
        self.upconvs = nn.ModuleList(
            UpBlock(inside, outside, 4, normalisation) for inside, outside in zip([in_channels, *channels], channels)
        )
        self.heads = nn.ModuleList(nn.Conv2d(count, sources, 3, padding=1) for count in channels[-_MASK_SCALES:])

    def forward(self, features: Tensor, references: list[Tensor]) -> list[Tensor]:
        """Decode the masks, finest first; `references` give the sizes to crop to, coarsest first."""
        masks: list[Tensor] = []
        for level, (upconv, reference) in enumerate(zip(self.upconvs, references)):
            features = crop_like(upconv(features), reference)
            head = level - len(self.upconvs) + _MASK_SCALES
            if head >= 0:
                masks.insert(0, torch.sigmoid(self.heads[head](features)))
        return masks


def _stage_layer(stage: int, kernel: int, variant: Variant, fidelity: Fidelity) -> Layer:
    dilation = 1
    if variant == "dilated" and stage in _DILATED_STAGES:
        dilation = 2 if fidelity == "paper" else 3  # 3 is coprime to the stride, see PoseNet
    return Layer(kernel, 2, dilation, deformable=stage in _DEFORMABLE_STAGES.get(variant, ()))
