"""Regularisation: smoothness of depth."""

from __future__ import annotations

import torch
from torch import Tensor


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
