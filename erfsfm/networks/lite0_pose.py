"""Camera motion between a target image and its sources by matching EfficientNet-Lite0's features.

Each image is encoded by itself. Cells of the target are matched with those of a source at 1/16, a network says how
sure each match is and how far away the cell, and the motion follows by least squares. Twice more, the source's features
at 1/8 are carried back by the motion and matched again. A rotation is thus solved for, not guessed: what is
learned are correspondences and whom to believe.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from erfsfm.geometry.alignment import FOCAL, align, cell_rays, image_positions, project, rotation_to_euler
from erfsfm.networks.blocks import ConvBlock, Layer, Variant, initialise, scaled
from erfsfm.networks.correlation import expected_place, local_correlation, offsets
from erfsfm.networks.lite0 import SKIP_CHANNELS, Lite0Encoder
from erfsfm.networks.pose_net import check_images

PRETRAINED_STAGES = 6  # the stem and five, to 1/16
_EIGHTH, _SIXTEENTH = 3, 5  # stages
_FINE, _COARSE = SKIP_CHANNELS[2:]
_CONTEXT = 64
_MATCHED = (24, 64)  # channels compared at 1/8 and at 1/16
_HIDDEN = 32
_REACH = (2, 3)  # cells at 1/8 on either side, rows and columns
_OUTLIERS = ((100.0, 6.0, 3.0), (3.0, 2.0))  # of the linearisations at 1/16, and of those of a round at 1/8
_ROUNDS = 2  # at 1/8
_CORRECTION = (0.05, 0.01)  # of a match at 1/16 and at 1/8, per unit of a head's answer, on the image plane
_SHARPNESS = 3.0  # its logarithm, of fresh networks
_FIRST_DEPTH = (-0.5, -2.0)  # logits of the inverse depth and of its relative sigma
_FARTHEST = 0.05  # inverse depth: 330 m
_LOG_RELATIVE_SIGMA = (-2.3, 1.0)


class Lite0PoseNet(nn.Module):
    """Features of each image, matches at 1/16 and 1/8, and the motion by least squares.

    The ``dfc`` variant has deformable 3 x 3 convolutions where the target's surroundings are looked at, the paper's
    way to a wider field.
    """

    def __init__(self, variant: Variant = "plain", width: float = 1.0, sources: int = 4) -> None:
        super().__init__()
        self.variant = variant
        self.fidelity = "default"
        self.sources = sources
        context, hidden = scaled(_CONTEXT, width), scaled(_HIDDEN, width)
        fine, coarse = (scaled(count, width) for count in _MATCHED)
        layer = Layer(3, 1, deformable=variant == "dfc")
        blocks = [ConvBlock(_COARSE, context, layer), ConvBlock(context, context, layer)]
        self.encoder = Lite0Encoder(self.input_channels, blocks, PRETRAINED_STAGES)
        self.matched_coarse = nn.Conv2d(_COARSE, coarse, 1)
        self.matched_fine = nn.Conv2d(_FINE, fine, 1)
        self.depth_head = nn.Conv2d(context + 2, 2, 1)
        self.coarse_head = _head(context + 5, hidden)
        self.surroundings = nn.Conv2d(_FINE + context + 2, hidden, 3, padding=1)
        self.likeness = nn.Conv2d((2 * _REACH[0] + 1) * (2 * _REACH[1] + 1) + 2, hidden, 1)
        self.fine_head = nn.Sequential(nn.ReLU(), _head(hidden, hidden))
        self.sharpness = nn.Parameter(torch.full((2,), _SHARPNESS))
        self.mask_decoder = None
        initialise(self, "default")
        for head in (self.coarse_head[-1], self.fine_head[-1][-1], self.depth_head):  # type: ignore[index]
            nn.init.zeros_(cast(Tensor, head.weight))
        with torch.no_grad():
            self.depth_head.bias.copy_(torch.tensor(_FIRST_DEPTH))  # type: ignore[union-attr]

    @property
    def input_channels(self) -> int:
        """Channels of the encoder's input."""
        return 3

    def encoder_layers(self) -> list[Layer]:
        """Geometry of the encoder's convolutions wider than a pixel, first to last."""
        return self.encoder.layers()

    def forward(self, target: Tensor, sources: Sequence[Tensor]) -> list[Tensor] | Tensor:
        """Predict the motion from the target camera to each source camera; arguments are those of ``PoseNet``.

        In training also the coarser estimates, coarsest first.
        """
        check_images(target, sources, self.sources)
        features = self.features(torch.cat([target, *sources])).chunk(1 + self.sources)
        return self.motion(features[0], features[1:])

    def features(self, image: Tensor) -> Tensor:
        """The pretrained features of images ``(B, 3, H, W)`` at 1/8 and 1/16 in one map ``(B, C, H / 16, W / 16)``."""
        maps = [image]
        for stage in self.encoder.stages[:PRETRAINED_STAGES]:
            maps.append(stage(maps[-1]))
        fine, coarse = maps[1 + _EIGHTH], maps[1 + _SIXTEENTH]
        missing = [2 * c - f for c, f in zip(coarse.shape[:1:-1], fine.shape[:1:-1])]
        fine = F.pad(fine, (0, missing[0], 0, missing[1]))
        return torch.cat([coarse, F.pixel_unshuffle(fine, 2)], dim=1)

    def motion(self, target: Tensor, sources: Sequence[Tensor]) -> list[Tensor] | Tensor:
        """What `forward` returns, from `features` of the target and of its sources."""
        with torch.autocast("cuda" if target.is_cuda else "cpu", enabled=False):
            estimates = self._estimates(target.float(), torch.stack(list(sources), dim=1).flatten(0, 1).float())
        return estimates if self.training else estimates[-1]

    def _estimates(self, target: Tensor, sources: Tensor) -> list[Tensor]:
        """Pose vectors ``(B, N, 6)`` after each round; sources ``(B * N, C, h, w)``."""
        count = len(sources) // len(target)
        (coarse, fine), (coarse_source, fine_source) = _split(target), _split(sources)
        context = self.encoder.stages[-1](coarse)
        h, w = map(int, coarse.shape[-2:])  # in a graph quotients of sizes would be double
        rays = cell_rays(h, w, (1 / h, 1 / w), coarse.device)
        placed = torch.cat([context, _as_map(rays[None, :, :2], h, w).expand(len(context), -1, -1, -1)], dim=1)
        inverse_depth, sigma = self._depth(placed)
        seen, sureness = expected_place(
            F.normalize(self.matched_coarse(coarse), dim=1).repeat_interleave(count, dim=0),
            F.normalize(self.matched_coarse(coarse_source), dim=1),
            rays[:, :2],
            self.sharpness[1].exp(),
        )
        shown = _as_map(torch.cat([5 * (seen - rays[:, :2]), sureness], dim=-1), h, w)
        answer = self.coarse_head(torch.cat([placed.repeat_interleave(count, dim=0), shown], dim=1))
        seen, information = _corrected(seen, answer, _CORRECTION[0])
        R = torch.eye(3, device=target.device).expand(len(sources), 3, 3)
        motion = (R, torch.zeros(len(sources), 3, device=target.device))
        depth = tuple(values.repeat_interleave(count, dim=0).flatten(1) for values in (inverse_depth, sigma))
        motion = align(seen, information, rays, (depth[0], depth[1]), motion, _OUTLIERS[0])
        vectors = [_vectors(motion, count)]
        depths = [_doubled(values, "bilinear").repeat_interleave(count, dim=0) for values in (inverse_depth, sigma)]
        matching = _Fine.of(self, fine, fine_source, _doubled(context, "nearest"), (depths[0], depths[1]))
        for _ in range(_ROUNDS):
            motion = matching.improved(motion)
            vectors.append(_vectors(motion, count))
        return vectors

    def _depth(self, placed: Tensor) -> tuple[Tensor, Tensor]:
        """Inverse depth and its sigma, ``(B, 1, h, w)`` each."""
        value, relative = self.depth_head(placed).split(1, dim=1)
        inverse_depth = _FARTHEST + F.softplus(value)
        return inverse_depth, inverse_depth * relative.clamp(*_LOG_RELATIVE_SIGMA).exp()


class _Fine:
    """Matching at 1/8 of the same images, round after round."""

    def __init__(self, network: Lite0PoseNet, target: Tensor, source: Tensor, surroundings: Tensor) -> None:
        self.network = network
        self.target = target
        self.source = source
        self.surroundings = surroundings
        self.size = (int(target.shape[-2]), int(target.shape[-1]))
        self.cell = (1 / self.size[0], 1 / self.size[1])
        self.rays = cell_rays(*self.size, self.cell, target.device)
        self.steps = offsets(_REACH, (self.cell[0] / FOCAL[1], self.cell[1] / FOCAL[0]), target.device)

    @classmethod
    def of(
        cls, network: Lite0PoseNet, fine: Tensor, fine_source: Tensor, context: Tensor, depth: tuple[Tensor, Tensor]
    ) -> _Fine:
        """Features ``(B, C, h, w)`` of targets and ``(B * N, C, h, w)`` of sources; depth as the latter."""
        count, size = len(fine_source) // len(fine), tuple(map(int, fine.shape[-2:]))
        rays = cell_rays(size[0], size[1], (1 / size[0], 1 / size[1]), fine.device)
        places = _as_map(rays[None, :, :2], *size).expand(len(fine), -1, -1, -1)
        surroundings = network.surroundings(torch.cat([fine, context, places], dim=1))
        matching = cls(
            network,
            F.normalize(network.matched_fine(fine), dim=1).repeat_interleave(count, dim=0),
            F.normalize(network.matched_fine(fine_source), dim=1),
            surroundings.repeat_interleave(count, dim=0),
        )
        matching.depth = (depth[0].flatten(1), depth[1].flatten(1))
        return matching

    depth: tuple[Tensor, Tensor]

    def improved(self, motion: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """The motion after another round."""
        R, t = (values.detach() for values in motion)
        h, w = self.size
        _, at, _ = project(self.rays, self.depth[0].detach(), R, t)
        grid = image_positions(at).reshape(-1, h, w, 2)
        back = F.grid_sample(self.source, grid, mode="bilinear", align_corners=False)
        back = F.pad(back, (_REACH[1], _REACH[1], _REACH[0], _REACH[0]))
        likeness = local_correlation(self.target, back, _REACH)
        chance = (self.network.sharpness[0].exp() * likeness).flatten(2).transpose(1, 2).softmax(dim=-1)
        moved = _as_map(5 * (at - self.rays[:, :2]), h, w)
        answer = self.network.fine_head(
            self.network.likeness(torch.cat([3 * likeness, moved], dim=1)) + self.surroundings
        )
        seen, information = _corrected(at + chance @ self.steps, answer, _CORRECTION[1])
        return align(seen, information, self.rays, self.depth, (R, t), _OUTLIERS[1])


def _head(inside: int, hidden: int) -> nn.Sequential:
    """Two 3 x 3 convolutions, and for each cell a correction of its match and logits of its information."""
    return nn.Sequential(
        nn.Conv2d(inside, hidden, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(hidden, hidden, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(hidden, 4, 1),
    )


def _split(features: Tensor) -> tuple[Tensor, Tensor]:
    """The map at 1/16 and that at 1/8."""
    return features[:, :_COARSE], F.pixel_shuffle(features[:, _COARSE:], 2)


def _as_map(values: Tensor, h: int, w: int) -> Tensor:
    """``(B, h * w, C)`` as ``(B, C, h, w)``."""
    return values.transpose(1, 2).reshape(len(values), -1, h, w)


def _doubled(features: Tensor, mode: str) -> Tensor:
    doubled: Tensor = F.interpolate(features, scale_factor=2.0, mode=mode)
    return doubled


def _corrected(seen: Tensor, answer: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """Matches ``(B, P, 2)`` corrected by a head's answer ``(B, 4, h, w)``, and their information."""
    correction, sureness = answer.flatten(2).transpose(1, 2).split(2, dim=-1)
    return seen + scale * correction, torch.sigmoid(sureness)


def _vectors(motion: tuple[Tensor, Tensor], count: int) -> Tensor:
    """Rotations and translations ``(B * N, ...)`` as pose vectors ``(B, N, 6)``."""
    R, t = motion
    vectors = torch.cat([t, rotation_to_euler(R)], dim=-1)
    return vectors.reshape(-1, count, 6)
