"""Consistency of depth between frames, and of rotations with two-view geometry."""

from __future__ import annotations

import torch
from torch import Tensor


def depth_inconsistency(z_source: Tensor, depth_source_sampled: Tensor) -> Tensor:
    """Relative disagreement in [0, 1): ``|a - b| / (a + b)``   (Bian et al. 2019, Eq. 5).

    Args:
        z_source: depth of the target's points in the source camera, ``(B, 1, H, W)``, positive.
        depth_source_sampled: the source's own depth map looked up at their projections, same shape.
    """
    return (z_source - depth_source_sampled).abs() / (z_source + depth_source_sampled)


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
