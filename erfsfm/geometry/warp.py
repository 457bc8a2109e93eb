"""The inverse warp: a source image seen from the target camera (Zhou et al. 2017, Section 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from erfsfm.geometry.camera import backproject
from erfsfm.geometry.transforms import transform_points

MINIMUM_Z = 1e-3


@dataclass(frozen=True)
class Projection:
    """Where each target pixel lands in the source image.

    ``grid`` ``(B, H, W, 2)`` in ``grid_sample`` coordinates (align_corners=True), ``valid`` ``(B, 1, H, W)``: in
    front of the source camera and inside its image, boolean.
    """

    grid: Tensor
    valid: Tensor


def project_into_source(depth: Tensor, T_source_target: Tensor, K: Tensor) -> Projection:
    """Project the target's points into the source camera.

    p_s ~ K T_source_target D(p_t) K^-1 p_t        (Zhou et al. 2017, Eq. 2)

    Args:
        depth: target z-depth ``(B, 1, H, W)``.
        T_source_target: ``(B, 4, 4)``.
        K: intrinsics shared by both images, ``(B, 3, 3)``.
    """
    batch, _, height, width = depth.shape
    points_source = transform_points(T_source_target, backproject(depth, K))  # (B, 3, H*W)
    z = points_source[:, 2:]
    pixels = (K @ points_source)[:, :2] / z.clamp(min=MINIMUM_Z)  # (B, 2, H*W)
    extents = max(width - 1, 1), max(height - 1, 1)
    axes = [2 * pixels[:, k : k + 1] / extent - 1 for k, extent in enumerate(extents)]  # (B, 1, H*W) each
    inside = z > MINIMUM_Z
    for axis, extent in zip(axes, extents):
        # half a thousandth of a pixel of slack: round-off must not cut the border off an identity warp
        inside = inside & (axis.abs() <= 1 + 1e-3 / extent)
    return Projection(
        grid=torch.cat(axes, dim=1).reshape(batch, 2, height, width).permute(0, 2, 3, 1),
        valid=inside.reshape(batch, 1, height, width),
    )


def sample(image: Tensor, projection: Projection) -> Tensor:
    """Bilinear look-up of ``image`` ``(B, C, H, W)`` at a projection; the border is repeated outside."""
    # far-outside coordinates would overflow the integer conversion inside grid_sample
    grid = torch.nan_to_num(projection.grid, nan=2.0).clamp(-2, 2)
    return F.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=True)
