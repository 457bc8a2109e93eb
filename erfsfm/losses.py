"""Photometric error between a target and a source warped onto it, smoothness of depth, and errors against labels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

C1, C2 = 0.01**2, 0.03**2

MAX_BOUND_RATIO = 1.5  # most over least
FARTHEST = 100.0  # camera heights: weights do not grow beyond
STEPS_PX = (1, 2, 4, 8)
LEAST_HALF_WIDTH = 1e-3  # of bounds, log inverse depth: those of exact depth have none
STILL = 0.01  # network units: added to the length of a step, against division by zero


Bounds = tuple[Tensor, Tensor]
"""Least and most inverse depth ``(B, 1, H, W)`` as measured: 0 where unbounded from below, infinite from above."""


class BoxMean(torch.autograd.Function):
    """Mean over each 3 x 3 window, as ``avg_pool2d(x, 3, 1)``, by separable additions.

    On a CPU this is several times faster than the pooling operator (make benchmark), which dominated the training step.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        """``(..., H, W)`` to ``(..., H - 2, W - 2)``."""
        return _box(x)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """The transposed window mean is the same window mean of the padded gradient."""
        return _box(F.pad(gradient, (2, 2, 2, 2)))


def _box(x: Tensor) -> Tensor:
    rows = x[..., :-2] + x[..., 1:-1]
    rows += x[..., 2:]
    box = rows[..., :-2, :] + rows[..., 1:-1, :]
    box += rows[..., 2:, :]
    return box.mul_(1 / 9)


box_mean: Callable[[Tensor], Tensor] = (
    BoxMean.apply
)  # over each 3 x 3 window of ``(..., H, W)``, without padding


def dissimilarity(first: Tensor, second: Tensor) -> Tensor:
    """``(1 - SSIM) / 2`` in a 3 x 3 window (Wang et al. 2004, Eq. 13), in [0, 1].

    Args:
        first: ``(B, C, H, W)`` in [0, 1].
        second: the same shape.

    Returns:
        ``(B, C, H, W)``.
    """
    a, b = F.pad(first, (1, 1, 1, 1), mode="reflect"), F.pad(second, (1, 1, 1, 1), mode="reflect")
    mean_a, mean_b = box_mean(a), box_mean(b)
    variance_a = box_mean(a * a) - mean_a * mean_a
    variance_b = box_mean(b * b) - mean_b * mean_b
    covariance = box_mean(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + C1) / (mean_a * mean_a + mean_b * mean_b + C1)
    structure = (2 * covariance + C2) / (variance_a + variance_b + C2)
    return ((1 - luminance * structure) / 2).clamp(0, 1)


def photometric_error(target: Tensor, warped: Tensor, ssim_weight: float) -> Tensor:
    """Per-pixel error ``w (1 - SSIM) / 2 + (1 - w) |difference|``.

    The difference is averaged over colour; structure is compared in the grey mean of the channels,
    which on a CPU costs a third of three channels.

    Args:
        target: ``(B, 3, H, W)`` in [0, 1].
        warped: the same shape.
        ssim_weight: w; 0 is the paper's plain L1.

    Returns:
        ``(B, 1, H, W)``.
    """
    absolute = (target - warped).abs().mean(dim=1, keepdim=True)
    if ssim_weight == 0:
        return absolute
    structural = dissimilarity(target.mean(dim=1, keepdim=True), warped.mean(dim=1, keepdim=True))
    return ssim_weight * structural + (1 - ssim_weight) * absolute


def second_order_smoothness(values: Tensor) -> Tensor:
    """Mean absolute second differences, not edge-aware: the paper's smoothness term.

    Args:
        values: depth or disparity, ``(B, 1, H, W)``.
    """
    dx, dy = values.diff(), values.diff(dim=-2)
    second = (dx.diff(), dx.diff(dim=-2), dy.diff(), dy.diff(dim=-2))
    return torch.stack([d.abs().mean() for d in second]).sum()


def edge_aware_smoothness(values: Tensor, image: Tensor) -> Tensor:
    """Mean absolute gradients of mean-normalised values, damped where the image has edges.

    |dx d*| exp(-|dx I|) + |dy d*| exp(-|dy I|),  d* = d / mean(d)   (Godard et al. 2019, Eq. 3)

    Args:
        values: depth or disparity, ``(B, 1, H, W)``.
        image: ``(B, 3, H, W)`` in [0, 1].
    """
    normalised = values / (values.mean(dim=(2, 3), keepdim=True) + 1e-7)
    terms = []
    for axis in (-1, -2):
        weight = torch.exp(-image.diff(dim=axis).abs().mean(dim=1, keepdim=True))
        terms.append((normalised.diff(dim=axis).abs() * weight).mean())
    return torch.stack(terms).sum()


def enlarged(disparity: Tensor, level: int, size: tuple[int, int]) -> Tensor:
    """Disparity ``(B, 1, h, w)`` of a pyramid level at the full size (height, width): ``(B, 1, H, W)``.

    A pixel of the level lies in the middle of its ``2**level`` by ``2**level`` pixels; the last may be cut off.
    """
    if level == 0:
        return disparity
    full = F.interpolate(disparity, scale_factor=2.0**level, mode="bilinear", align_corners=False)
    return full[..., : size[0], : size[1]]


def disagreement(disparity: Tensor, bounds: Bounds, log_scale: float) -> Tensor:
    """Mean Huber loss of log disparity, over pixels with a bound.

    Between both bounds it is the square of the distance from their middle, outside it is linear with slope 1: a pixel
    is drawn to what was measured, the less the wider its bounds. One bound alone counts only where it is violated: the
    mean is not over the sky that is far enough.
    Far surfaces are few pixels beside near ones, so a pixel weighs by the square root of its depth.

    Args:
        disparity: inverse depth ``(B, 1, H, W)``, positive.
        bounds: of the same size.
        log_scale: log of the disparity's scale over that of the bounds.
    """
    has_least, has_most = bounds[0] > 0, torch.isfinite(bounds[1])
    scaled = disparity.log() - log_scale
    least = bounds[0].clamp(min=1e-6).log()
    most = bounds[1].clamp(min=1e-6).log()
    both = has_least & has_most
    middle = torch.where(both, (least + most) / 2, 0)
    half = torch.where(both, (most - least) / 2, 1).clamp(min=LEAST_HALF_WIDTH)
    apart = (scaled - middle).abs()
    huber = torch.where(apart < half, apart.square() / (2 * half), apart - half / 2)
    one_sided = (least - scaled).clamp(min=0) * has_least + (scaled - most).clamp(min=0)
    nearest = torch.where(has_most, bounds[1], bounds[0]).clamp(min=1 / FARTHEST)
    counts = both | (one_sided.detach() > 0)
    weight = torch.where(counts, nearest.rsqrt(), 0)
    mean: Tensor = (weight * torch.where(both, huber, one_sided)).sum() / weight.sum().clamp(min=1)
    return mean


def step_disagreement(disparity: Tensor, bounds: Bounds) -> Tensor:
    """Mean error of the steps of log disparity between pixels 1, 2, 4 and 8 apart, where both have narrow bounds.

    Depth edges are few pixels of a depth error and most of this one (Ranftl et al. 2020, scale-invariant gradients).

    Args:
        disparity: inverse depth ``(B, 1, H, W)``, positive, at any scale.
        bounds: of the same size.
    """
    least, most = bounds
    narrow = (least > 0) & (most < MAX_BOUND_RATIO * least)
    middle = torch.where(narrow, (least * most).sqrt(), 1)
    error = torch.where(narrow, disparity.log() - middle.log(), 0)
    total = disparity.new_zeros(())
    for apart in STEPS_PX:
        for axis in (2, 3):
            length = max(error.shape[axis] - apart, 0)
            start = error.shape[axis] - length
            both = narrow.narrow(axis, 0, length) & narrow.narrow(axis, start, length)
            # the first part comes first: gradients are summed in the order in which parts are made
            first = error.narrow(axis, 0, length)
            step = error.narrow(axis, start, length) - first
            total = total + (step.abs() * both).sum() / both.sum().clamp(min=1)
    return total / (2 * len(STEPS_PX))


def rotation_disagreement(R_predicted: Tensor, R_measured: Tensor) -> Tensor:
    """Mean chordal distance ``|R_p - R_m|_F = 2 sqrt(2) sin(angle / 2)`` over the measured rotations.

    Args:
        R_predicted: ``(..., 3, 3)``.
        R_measured: the same shape; NaN marks what was not measured and does not count.
    """
    measured = torch.isfinite(R_measured).all(dim=-1).all(dim=-1)
    difference = (R_predicted - torch.nan_to_num(R_measured)).square().sum(dim=(-2, -1))
    distance = torch.sqrt(difference + 1e-12) * measured
    return distance.sum() / measured.sum().clamp(min=1)


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
