"""SE(3) on tensors, and the inverse warp: a source image seen from the target camera (Zhou et al. 2017)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from erfsfm.geometry.camera import backproject


def euler_to_rotation(euler: Tensor) -> Tensor:
    """Rotation matrices of intrinsic XYZ Euler angles, ``R = Rx Ry Rz``.

    Args:
        euler: ``(..., 3)`` radians.

    Returns:
        ``(..., 3, 3)``.
    """
    cx, cy, cz = euler.cos().unbind(-1)
    sx, sy, sz = euler.sin().unbind(-1)
    rows = [
        cy * cz,
        -cy * sz,
        sy,
        cx * sz + sx * sy * cz,
        cx * cz - sx * sy * sz,
        -sx * cy,
        sx * sz - cx * sy * cz,
        sx * cz + cx * sy * sz,
        cx * cy,
    ]
    return torch.stack(rows, dim=-1).reshape(*euler.shape[:-1], 3, 3)


def pose_vector_to_matrix(pose_vec_trans_euler: Tensor) -> Tensor:
    """``T_source_target`` from the network's six-vector: translation first, then XYZ Euler.

    Args:
        pose_vec_trans_euler: ``(..., 6)``.

    Returns:
        ``(..., 4, 4)``.
    """
    translation, euler = pose_vec_trans_euler[..., :3], pose_vec_trans_euler[..., 3:]
    top = torch.cat([euler_to_rotation(euler), translation.unsqueeze(-1)], dim=-1)  # (..., 3, 4)
    none = torch.zeros_like(top[..., :1, :])
    return torch.cat([top, torch.cat([none[..., :3], none[..., 3:] + 1], dim=-1)], dim=-2)


def transform_points(T_a_b: Tensor, points_b: Tensor) -> Tensor:
    """Points ``(B, 3, P)`` in b moved to a by ``T_a_b`` ``(B, 4, 4)``."""
    return T_a_b[:, :3, :3] @ points_b + T_a_b[:, :3, 3:]


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
