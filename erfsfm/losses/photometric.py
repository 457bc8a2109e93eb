"""Photometric error between a target image and a source warped onto it, and smoothness of depth."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

C1, C2 = 0.01**2, 0.03**2


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


def box_mean(x: Tensor) -> Tensor:
    """Mean over each 3 x 3 window of ``(..., H, W)``, without padding."""
    mean: Tensor = BoxMean.apply(x)  # type: ignore[no-untyped-call]
    return mean


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


def _dx(x: Tensor) -> Tensor:
    return x[..., :, 1:] - x[..., :, :-1]


def _dy(x: Tensor) -> Tensor:
    return x[..., 1:, :] - x[..., :-1, :]


def second_order_smoothness(values: Tensor) -> Tensor:
    """Mean absolute second differences, not edge-aware: the paper's smoothness term.

    Args:
        values: depth or disparity, ``(B, 1, H, W)``.
    """
    dx, dy = _dx(values), _dy(values)
    second = (_dx(dx), _dy(dx), _dx(dy), _dy(dy))
    return torch.stack([d.abs().mean() for d in second]).sum()


def edge_aware_smoothness(values: Tensor, image: Tensor) -> Tensor:
    """Mean absolute gradients of mean-normalised values, damped where the image has edges.

    |dx d*| exp(-|dx I|) + |dy d*| exp(-|dy I|),  d* = d / mean(d)   (Godard et al. 2019, Eq. 3)

    Args:
        values: depth or disparity, ``(B, 1, H, W)``.
        image: ``(B, 3, H, W)`` in [0, 1].
    """
    normalised = values / (values.mean(dim=(2, 3), keepdim=True) + 1e-7)
    weight_x = torch.exp(-_dx(image).abs().mean(dim=1, keepdim=True))
    weight_y = torch.exp(-_dy(image).abs().mean(dim=1, keepdim=True))
    return (_dx(normalised).abs() * weight_x).mean() + (_dy(normalised).abs() * weight_y).mean()
