"""The network that fuses learned depth with the measurements of neighbouring images."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

WIDTHS = (16, 32, 64, 96)
LEVELS = len(WIDTHS) - 1  # halvings inside the network
_TRUST = 3.0  # of a fresh network in the measurement: its logit
_UNSURE = -3.0  # logarithm of its sigma
_LARGEST_CHANGE = 2.0


class FusionNet(nn.Module):
    """Evidence ``(B, channels, h, w)`` to the change of log inverse depth and the log of its sigma, ``(B, 2h, 2w)``.

    The change is a mean of the measured one and one of its own, so a trusted measurement keeps its precision. Height
    and width are multiples of ``2 ** LEVELS``.

    Args:
        channels: of the evidence.
        measured: the first of the four channels with the measured change.
    """

    def __init__(self, channels: int, measured: int) -> None:
        super().__init__()
        self._measured = measured
        self.down = nn.ModuleList(
            nn.Sequential(*_layer(a, b), *_layer(b, b)) for a, b in pairwise((channels, *WIDTHS))
        )
        self.narrow = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in pairwise(WIDTHS[::-1]))
        self.up = nn.ModuleList(nn.Sequential(*_layer(width, width)) for width in WIDTHS[-2::-1])
        self.head = nn.Conv2d(WIDTHS[0], 12, 3, padding=1)
        nn.init.zeros_(self.head.weight)
        assert self.head.bias is not None
        with torch.no_grad():
            self.head.bias.copy_(torch.tensor([_TRUST, 0.0, _UNSURE]).repeat_interleave(4))

    def forward(self, evidence: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        kept = [self.down[0](evidence)]
        for block in list(self.down)[1:]:
            kept.append(block(functional.max_pool2d(kept[-1], 2)))
        decided = kept.pop()
        for narrow, block in zip(self.narrow, self.up, strict=True):
            larger = functional.interpolate(
                narrow(decided), scale_factor=2, mode="bilinear", align_corners=False
            )
            decided = block(larger + kept.pop())
        trust, own, log_sigma = self.head(decided).float().split(4, 1)
        trust = torch.sigmoid(trust)
        measured = evidence[:, self._measured : self._measured + 4]
        change = trust * measured + (1 - trust) * _LARGEST_CHANGE * torch.tanh(own)
        return functional.pixel_shuffle(change, 2)[:, 0], functional.pixel_shuffle(log_sigma, 2)[
            :, 0
        ]


def _layer(inputs: int, outputs: int) -> list[nn.Module]:
    return [
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(),
    ]
