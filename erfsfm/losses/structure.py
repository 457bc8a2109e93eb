"""Agreement of the networks with structure measured by classical geometry, whose scale may be a little off."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

SURE = 1.5  # most over least
FARTHEST = 100.0  # camera heights: what is farther weighs no more
STILL = 0.01  # network units: a step so short counts as no movement


@dataclass(frozen=True)
class Bounds:
    """Between which inverse depths the measurements lie.

    Attributes:
        least: ``(B, 1, H, W)``, 0 where nothing bounds it from below.
        most: ``(B, 1, H, W)``, infinite where nothing bounds it from above.
    """

    least: Tensor
    most: Tensor

    def strided(self, step: int) -> Bounds:
        """Every ``step``-th pixel, from the middle of each block."""
        middle = step // 2
        return Bounds(self.least[..., middle::step, middle::step], self.most[..., middle::step, middle::step])

    def log_scale(self, disparity: Tensor) -> Tensor:
        """``(B, 1, 1, 1)`` mean of log disparity minus log measured, over sure pixels; 0 where there are none."""
        sure = (self.least > 0) & (self.most < SURE * self.least)
        middle = torch.where(sure, (self.least * self.most).sqrt(), 1)
        difference = torch.where(sure, disparity.log() - middle.log(), 0).sum(dim=(1, 2, 3), keepdim=True)
        return difference / sure.sum(dim=(1, 2, 3), keepdim=True).clamp(min=1)


def outside(disparity: Tensor, bounds: Bounds, log_scale: Tensor) -> Tensor:
    """Mean log distance of a disparity from the bounds, over pixels with a bound; nothing within them.

    Far surfaces are few pixels and easily blurred away by the near ones around them: a pixel weighs by the square root
    of its depth.

    Args:
        disparity: inverse depth ``(B, 1, H, W)``, positive.
        bounds: of the same size.
        log_scale: logarithm of the disparity's scale over the measured one, ``(B, 1, 1, 1)``.
    """
    has_most = torch.isfinite(bounds.most)
    said = disparity.log() - log_scale
    below = (bounds.least.clamp(min=1e-6).log() - said).clamp(min=0)
    above = (said - bounds.most.clamp(min=1e-6).log()).clamp(min=0)
    nearest = torch.where(has_most, bounds.most, bounds.least).clamp(min=1 / FARTHEST)
    weight = torch.where(has_most | (bounds.least > 0), nearest.rsqrt(), 0)
    distance: Tensor = (weight * (below + above)).sum() / weight.sum().clamp(min=1)
    return distance


def translation_disagreement(t_predicted: Tensor, t_measured: Tensor) -> Tensor:
    """Mean of ``|t_p - t_m| / (|t_m| + 0.01)`` over the measured translations.

    Args:
        t_predicted: ``(..., 3)``.
        t_measured: the same shape and unit; NaN marks what was not measured and does not count.
    """
    measured = torch.isfinite(t_measured).all(dim=-1)
    target = torch.nan_to_num(t_measured)
    distance = torch.sqrt((t_predicted - target).square().sum(dim=-1) + 1e-12)
    relative = distance / (target.norm(dim=-1) + STILL) * measured
    mean: Tensor = relative.sum() / measured.sum().clamp(min=1)
    return mean
